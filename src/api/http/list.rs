//! The list of a caller's jobs.

use std::sync::Arc;

use axum::extract::{Extension, Query, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::results::whole;
use super::view::JobView;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::service::Service;
use crate::job::{Job, JobId, State as JobState};

/// Upper bound on the text of a job on a page, without its options and its report, bytes.
const VIEW_BYTES: usize = 2048;

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
) -> Result<Response, ApiError> {
    let Query(page) = page.map_err(|error| ApiError::BadRequest(error.body_text()))?;
    let before = page.before.as_deref().map(str::parse::<JobId>).transpose();
    let before = before.map_err(|error| ApiError::BadRequest(format!("before: {error}")))?;
    let limit = page.limit.unwrap_or(PAGE).clamp(1, 1000);
    let listed = service.jobs(&caller, page.state, page.label, before, limit);
    let (jobs, next) = listed.await?;
    let texts = |job: &Arc<Job>| job.options.len() + job.report.as_ref().map_or(0, String::len);
    let bytes = jobs.iter().map(|job| VIEW_BYTES + texts(job)).sum();
    let room = service.answers.room(&caller.tenant, bytes).await?;
    let view = |job: &Arc<Job>| JobView::shown_to(&caller, job, &[]);
    let page = JobPage {
        jobs: jobs.iter().map(view).collect(),
        next: next.map(|id| id.to_string()),
    };
    let text = serde_json::to_vec(&page).map_err(ApiError::internal)?;
    let media = [(header::CONTENT_TYPE, "application/json")];
    Ok((media, whole(room.hold(text))).into_response())
}
