//! The HTTP door: routes, and what stands before all of them.
//!
//! The only room that sees axum's types, but for the ports themselves.

mod answer;
mod bodies;
mod events;
mod handlers;
mod metered;
mod named;
mod openapi;
mod prefer;
mod problem;
mod view;

use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};

use super::service::Service;

/// The routes of the HTTP door.
pub(super) fn router(service: &Arc<Service>) -> Router {
    Router::new()
        .route("/v1/flow", post(handlers::estimate))
        .route("/v1/sequences", post(handlers::submit_sequence))
        .route(
            "/v1/jobs",
            post(handlers::submit_job).get(handlers::list_jobs),
        )
        .route(
            "/v1/jobs/{id}",
            get(handlers::get_job).delete(handlers::cancel_job),
        )
        .route("/v1/jobs/{id}/requeue", post(handlers::requeue_job))
        .route("/v1/jobs/{id}/events", get(events::follow_job))
        .route("/v1/jobs/{id}/result", get(answer::result))
        .merge(openapi::router())
        .method_not_allowed_fallback(problem::method)
        // Bodies are counted as they come, against limits of the service's own.
        .layer(DefaultBodyLimit::disable())
        .with_state(Arc::clone(service))
}
