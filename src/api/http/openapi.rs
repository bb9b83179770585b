//! The OpenAPI document, generated from the handlers, and the Swagger UI.

use std::sync::Arc;

use axum::Router;
use utoipa::openapi::security::{Http, HttpAuthScheme, SecurityScheme};
use utoipa::{Modify, OpenApi};
use utoipa_swagger_ui::SwaggerUi;

use super::{events, handlers, results};
use crate::api::service::Service;

struct Bearer;

impl Modify for Bearer {
    fn modify(&self, document: &mut utoipa::openapi::OpenApi) {
        let scheme = SecurityScheme::Http(Http::new(HttpAuthScheme::Bearer));
        let components = document.components.get_or_insert_with(Default::default);
        components.add_security_scheme("key", scheme);
    }
}

/// The OpenAPI document.
#[derive(OpenApi)]
#[openapi(
    info(
        title = "fnsf",
        description = "Scene flow as a service: two lidar clouds in, the motion of every point out."
    ),
    paths(
        handlers::estimate,
        handlers::submit_sequence,
        handlers::submit_job,
        handlers::list_jobs,
        handlers::get_job,
        handlers::cancel_job,
        handlers::requeue_job,
        events::follow_job,
        results::result,
        results::tracks,
    ),
    security((), ("key" = [])),
    modifiers(&Bearer),
    tags(
        (name = "flow", description = "A pair in, its flow out, on one call"),
        (name = "jobs", description = "Work that outlives the call"),
    )
)]
struct Contract;

/// The routes `/openapi.json` and `/docs`.
pub(super) fn router() -> Router<Arc<Service>> {
    SwaggerUi::new("/docs")
        .url("/openapi.json", Contract::openapi())
        .into()
}
