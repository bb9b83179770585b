//! The route `/v1/street/{sweep}`: sweeps of a simulated street, to try the service with.

use std::sync::Arc;

use axum::extract::{Extension, Path, Query, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::problem::Problem;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::service::Service;

/// The query parameters of a sweep of the street.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Which {
    /// The seed of the street.
    #[serde(default)]
    seed: u64,
}

/// Returns a sweep of a simulated street as a PCD file, to try the service without data.
///
/// The street has 50 sweeps of about 120,000 points, 0.1 s apart.
#[utoipa::path(
    get,
    path = "/v1/street/{sweep}",
    tag = "server",
    params(
        ("sweep" = usize, Path, description = "The index of the sweep, 0 to 49"),
        ("seed" = Option<u64>, Query, description = "The seed of the street; 0 by default"),
    ),
    responses(
        (status = 200, description = "The sweep", content_type = "application/x-pcd"),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn street(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    sweep: Result<Path<usize>, axum::extract::rejection::PathRejection>,
    which: Result<Query<Which>, axum::extract::rejection::QueryRejection>,
) -> Result<Response, ApiError> {
    let Path(sweep) = sweep.map_err(|error| ApiError::BadRequest(error.body_text()))?;
    let Query(which) = which.map_err(|error| ApiError::BadRequest(error.body_text()))?;
    let bytes = service.street_sweep(&caller, which.seed, sweep).await?;
    Ok(([(header::CONTENT_TYPE, "application/x-pcd")], bytes).into_response())
}
