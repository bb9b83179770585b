//! The list of a caller's jobs.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Extension, Query, State};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::view::JobView;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::service::Service;
use crate::job::{JobId, State as JobState};

/// Default number of jobs on a page.
const PAGE: u32 = 100;

/// The query parameters of a list request.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Page {
    /// Only jobs in this state.
    state: Option<JobState>,
    /// Only jobs with this label, `name=value`.
    label: Option<String>,
    /// Maximum number of jobs, 1 to 1000. The default is 100.
    limit: Option<u32>,
    /// Only jobs older than this job id: the value of `next` on the page before.
    before: Option<String>,
}

/// A page of jobs, latest first.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobPage {
    /// The jobs. The pairs of a sequence are not listed as separate jobs.
    jobs: Vec<JobView>,
    /// The value of `before` for the next page. Null on the last page.
    next: Option<String>,
}

/// Lists the caller's jobs, latest first.
#[utoipa::path(
    get,
    path = "/v1/jobs",
    tag = "jobs",
    params(
        ("state" = Option<JobState>, Query, description = "Only those in this state"),
        ("label" = Option<String>, Query, description = "Only those with this label, as name=value"),
        ("limit" = Option<u32>, Query, description = "At most so many, 1 to 1000; 100 by default"),
        ("before" = Option<String>, Query, description = "Only those before this one: next of the page before"),
    ),
    responses((status = 200, description = "A page of jobs", body = JobPage))
)]
pub(super) async fn list_jobs(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    page: Result<Query<Page>, axum::extract::rejection::QueryRejection>,
) -> Result<Json<JobPage>, ApiError> {
    let Query(page) = page.map_err(|error| ApiError::BadRequest(error.body_text()))?;
    let before = page.before.as_deref().map(str::parse::<JobId>).transpose();
    let before = before.map_err(|error| ApiError::BadRequest(format!("before: {error}")))?;
    let limit = page.limit.unwrap_or(PAGE).clamp(1, 1000);
    let jobs = service
        .jobs(&caller, page.state, page.label, before, limit)
        .await?;
    let full = jobs.len() == limit as usize;
    let next = jobs.last().filter(|_| full).map(|job| job.id.to_string());
    Ok(Json(JobPage {
        jobs: jobs.iter().map(|job| JobView::new(job, &[])).collect(),
        next,
    }))
}
