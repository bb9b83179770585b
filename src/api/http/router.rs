//! The HTTP routes.

use std::sync::Arc;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};

use super::{events, handlers, info, openapi, problem, results};
use crate::api::service::Service;

/// The HTTP routes, with the OpenAPI document and its page.
pub(crate) fn router(service: &Arc<Service>) -> Router {
    Router::new()
        .route("/v1/info", get(info::info))
        .route("/v1/flow", post(handlers::estimate))
        .route("/v1/sequences", post(handlers::submit_sequence))
        .route(
            "/v1/jobs",
            post(handlers::submit_job).get(handlers::list_jobs),
        )
        .route(
            "/v1/jobs/{id}",
            get(handlers::get_job).delete(handlers::delete_job),
        )
        .route("/v1/jobs/{id}/requeue", post(handlers::requeue_job))
        .route("/v1/jobs/{id}/events", get(events::follow_job))
        .route("/v1/jobs/{id}/result", get(results::result))
        .route("/v1/jobs/{id}/tracks", get(results::tracks))
        .merge(openapi::router())
        .method_not_allowed_fallback(problem::method)
        // Body sizes are limited while they are read, by the service's own limits.
        .layer(DefaultBodyLimit::disable())
        .with_state(Arc::clone(service))
}
