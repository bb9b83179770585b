//! The HTTP routes.

use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};

use super::{
    console, events, handlers, info, list, openapi, problem, queue, results, scene, share, street,
};
use crate::api::service::Service;

/// The HTTP routes, with the OpenAPI document and its page. `has_console` adds the console.
pub(crate) fn router(service: &Arc<Service>, has_console: bool) -> Router {
    let console = match has_console {
        true => console::router(),
        false => Router::new(),
    };
    Router::new()
        .route("/v1/info", get(info::info))
        .route("/v1/flow", post(handlers::estimate))
        .route("/v1/sequences", post(handlers::submit_sequence))
        .route("/v1/jobs", post(handlers::submit_job).get(list::list_jobs))
        .route(
            "/v1/jobs/{id}",
            get(handlers::get_job).delete(handlers::delete_job),
        )
        .route("/v1/jobs/{id}/requeue", post(handlers::requeue_job))
        .route("/v1/jobs/{id}/events", get(events::follow_job))
        .route("/v1/jobs/{id}/result", get(results::result))
        .route("/v1/jobs/{id}/tracks", get(results::tracks))
        .route("/v1/jobs/{id}/scene", get(scene::scene))
        .route("/v1/jobs/{id}/sweeps/{index}", get(scene::sweep))
        .route("/v1/jobs/{id}/share", post(share::share))
        .route("/v1/queue", get(queue::queue))
        .route("/v1/street/{sweep}", get(street::street))
        .merge(openapi::router())
        .merge(console)
        .method_not_allowed_fallback(problem::method)
        // Body sizes are limited while they are read, by the service's own limits.
        .layer(DefaultBodyLimit::disable())
        .with_state(Arc::clone(service))
}
