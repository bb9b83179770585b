//! The route `/v1/queue`: the queue, the devices and the nodes.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Extension, State};

use super::problem::Problem;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::queue_view::QueueView;
use crate::api::service::Service;

/// Returns the queued jobs with their predicted waits, the devices and the nodes.
///
/// A key of role `operate` sees the jobs of all tenants, the devices and the nodes. Other keys see
/// the jobs of their tenant, and the sums.
#[utoipa::path(
    get,
    path = "/v1/queue",
    tag = "server",
    responses(
        (status = 200, description = "The queue", body = QueueView),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn queue(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
) -> Result<Json<QueueView>, ApiError> {
    Ok(Json(service.queue_view(&caller).await?))
}
