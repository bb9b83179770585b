//! The handlers of the job routes: estimate, submit, get, cancel and requeue.

use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Extension, Query, Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Deserialize;

use super::multipart::{Body, PairFiles, Part, bad_poses, poses_of_a_pair};
use super::named::Named;
use super::prefer::Prefer;
use super::problem::Problem;
use super::view::JobView;
use super::{results, view};
use crate::api::admission::Durability;
use crate::api::auth::Caller;
use crate::api::codec::AnswerFormat;
use crate::api::error::ApiError;
use crate::api::job_request::{Received, Request as JobRequest};
use crate::api::pending_job::{Accepted, PendingJob};
use crate::api::service::{MakeDurable, Service, Waited};
use crate::api::sweep_order::SweepOrder;
use crate::formats::PoseFile;
use crate::job::{Job, JobOptions, Kind};
use crate::queue::PairOf;

/// Maximum duration of a long poll.
pub(super) const MAX_POLL: Duration = Duration::from_secs(60);

/// The parameters of a submission from its headers.
struct RequestHeaders {
    prefer: Prefer,
    key: Option<String>,
    received: Received,
}

impl RequestHeaders {
    fn of(headers: &HeaderMap, received: Received) -> Result<Self, ApiError> {
        let key = match headers.get("idempotency-key") {
            None => None,
            Some(value) => {
                let text = value.to_str().map_err(|_| {
                    ApiError::BadRequest("an idempotency key is plain text".to_owned())
                })?;
                Some(text.trim_matches('"').to_owned())
            }
        };
        Ok(Self {
            prefer: Prefer::from_headers(headers),
            key,
            received,
        })
    }

    fn job_request(&self, options: JobOptions, durability: Durability) -> JobRequest {
        let wait_is_deadline = durability == Durability::Ephemeral && !self.prefer.respond_async;
        JobRequest {
            options,
            durability,
            idempotency_key: self.key.clone(),
            received: self.received.clone(),
            time_left: self.prefer.wait.filter(|_| wait_is_deadline),
            link: None,
            pair: PairOf::ALONE,
        }
    }
}

/// Estimates the flow of one pair and returns it.
///
/// Without `Prefer` the response is sent when the flow is available. `Prefer: wait=N` sets a
/// deadline: after N seconds the best flow so far is returned, with `Fnsf-Stop-Reason: deadline`.
/// With `Prefer: respond-async` the response is a job. With `respond-async, wait=N` it is a job if
/// the flow is not available after N seconds. If the client disconnects while the server waits for
/// the flow, the estimate is cancelled.
#[utoipa::path(
    post,
    path = "/v1/flow",
    tag = "flow",
    request_body(content = super::multipart::PairBody, content_type = "multipart/form-data"),
    params(
        ("Accept" = Option<String>, Header, description = "The format of the flow; application/x-npz by default"),
        ("Prefer" = Option<String>, Header, description = "respond-async, wait=N"),
        ("Idempotency-Key" = Option<String>, Header, description = "A repeated request with the same key finds the first one's job"),
    ),
    responses(
        (status = 200, description = "The flow, in the format that Accept names", content_type = "application/x-npz"),
        (status = 202, description = "A job to ask after", body = JobView),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
        (status = "5XX", description = "A failure, or a full server with Retry-After", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn estimate(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Extension(received): Extension<Received>,
    headers: HeaderMap,
    request: Request,
) -> Result<Response, ApiError> {
    let accept = headers
        .get(header::ACCEPT)
        .and_then(|value| value.to_str().ok());
    let format = AnswerFormat::accepted(accept)?;
    let asked = RequestHeaders::of(&headers, received)?;
    let durability = match asked.prefer {
        Prefer {
            respond_async: true,
            wait: None,
        } => Durability::Durable,
        _ => Durability::Ephemeral,
    };
    let Accepted { job, awaited, .. } =
        submit_pair(&service, caller, &asked, durability, request).await?;
    if durability == Durability::Durable {
        return Ok(accepted(&service, &job, asked.prefer).await);
    }
    let longest = asked.prefer.wait.filter(|_| asked.prefer.respond_async);
    let response = match service.wait(job.id, longest).await? {
        Waited::Ended(job) => results::flow(&service, &job, format).await,
        Waited::StillOpen(job) if longest.is_some() => match service.make_durable(&job).await {
            Ok(job) => Ok(accepted(&service, &job, asked.prefer).await),
            Err(MakeDurable::GivenUp) => Err(ApiError::Cancelled(job.id)),
            Err(MakeDurable::Failed(error)) => return Err(error),
        },
        Waited::StillOpen(_) => return Err(ApiError::Draining),
    };
    if let Some(awaited) = awaited {
        awaited.disarm();
    }
    response
}

async fn submit_pair(
    service: &Arc<Service>,
    caller: Caller,
    asked: &RequestHeaders,
    durability: Durability,
    request: Request,
) -> Result<Accepted, ApiError> {
    let mut body = Body::of(service, &caller, request).await?;
    match read_pair(service, &caller, asked, durability, &mut body).await {
        Ok(pending) => {
            service.metrics.phase("decode", body.decode_seconds(), None);
            pending.submit(Kind::Pair).await
        }
        Err(error) => {
            body.drain().await;
            Err(error)
        }
    }
}

/// Reads source, target and options, and creates the draft.
async fn read_pair(
    service: &Arc<Service>,
    caller: &Caller,
    asked: &RequestHeaders,
    durability: Durability,
    body: &mut Body,
) -> Result<PendingJob, ApiError> {
    service.check_room(caller, None, durability)?;
    let (mut files, mut options) = (PairFiles::default(), JobOptions::default());
    while let Some(part) = body.next().await? {
        match part {
            Part::Options(read) => options = *read,
            Part::Poses(_) => return Err(poses_of_a_pair()),
            Part::File(part, name, bytes) => {
                files.take(&part, name, bytes)?;
            }
        }
    }
    options.check_for_pairs()?;
    service.check_room(caller, Some(&options), durability)?;
    let mut pending = PendingJob::begin(
        service,
        caller.clone(),
        asked.job_request(options, durability),
    )?;
    files.push_to(body, &mut pending).await?;
    Ok(pending)
}

/// Submits a pair or a sequence as a job.
///
/// The body is the same as for `/v1/flow` or `/v1/sequences`. The response is sent when the job is
/// stored on disk. The job then survives a disconnect of the client and a restart of the server.
#[utoipa::path(
    post,
    path = "/v1/jobs",
    tag = "jobs",
    request_body(content = super::multipart::PairBody, content_type = "multipart/form-data"),
    params(("Idempotency-Key" = Option<String>, Header, description = "A repeated request with the same key finds the first one's job")),
    responses(
        (status = 202, description = "A new job; Location names it", body = JobView),
        (status = 200, description = "The job of an earlier request with the same key", body = JobView),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
        (status = "5XX", description = "A failure, or a full server with Retry-After", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn submit_job(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Extension(received): Extension<Received>,
    headers: HeaderMap,
    request: Request,
) -> Result<Response, ApiError> {
    let asked = RequestHeaders::of(&headers, received)?;
    submit(&service, caller, &asked, request).await
}

/// Submits a sequence of sweeps as a job, for the flow of each consecutive pair.
///
/// The parts `options` and `poses` must precede the sweeps. The result is a zip archive with one flow per pair.
/// Each pair is a separate job, and its flow is available as soon as that job has succeeded. With
/// `densify` the result is one dense cloud: the points of all sweeps, transformed to one reference
/// time.
#[utoipa::path(
    post,
    path = "/v1/sequences",
    tag = "jobs",
    request_body(content = super::multipart::SequenceBody, content_type = "multipart/form-data"),
    params(("Idempotency-Key" = Option<String>, Header, description = "A repeated request with the same key finds the first one's job")),
    responses(
        (status = 202, description = "A new job; Location names it", body = JobView),
        (status = 200, description = "The job of an earlier request with the same key", body = JobView),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn submit_sequence(
    service: State<Arc<Service>>,
    caller: Extension<Caller>,
    received: Extension<Received>,
    headers: HeaderMap,
    request: Request,
) -> Result<Response, ApiError> {
    submit_job(service, caller, received, headers, request).await
}

/// Reads a body with source and target, or with sweeps, and submits it as a durable job.
async fn submit(
    service: &Arc<Service>,
    caller: Caller,
    asked: &RequestHeaders,
    request: Request,
) -> Result<Response, ApiError> {
    let mut body = Body::of(service, &caller, request).await?;
    let (pending, kind) = match read_job(service, &caller, asked, &mut body).await {
        Ok(read) => read,
        Err(error) => {
            body.drain().await;
            return Err(error);
        }
    };
    let Accepted { job, new, .. } = pending.submit(kind).await?;
    service
        .metrics
        .phase("decode", body.decode_seconds(), Some(&job));
    let mut response = accepted(service, &job, Prefer::default()).await;
    if !new {
        *response.status_mut() = StatusCode::OK;
    }
    Ok(response)
}

async fn read_job(
    service: &Arc<Service>,
    caller: &Caller,
    asked: &RequestHeaders,
    body: &mut Body,
) -> Result<(PendingJob, Kind), ApiError> {
    service.check_room(caller, None, Durability::Durable)?;
    let mut files = PairFiles::default();
    let mut options = JobOptions::default();
    let mut sweeps: Option<PendingJob> = None;
    let mut poses: Option<Arc<PoseFile>> = None;
    let mut order = SweepOrder::default();
    while let Some(part) = body.next().await? {
        match part {
            Part::Options(_) | Part::Poses(_) if sweeps.is_some() => {
                let text = "options and poses come before the sweeps";
                return Err(ApiError::BadRequest(text.to_owned()));
            }
            Part::Options(read) => options = *read,
            Part::Poses(read) => poses = Some(Arc::new(read)),
            Part::File(part, name, bytes) if part == "sweep" && files.is_empty() => {
                order.push(name.as_deref().unwrap_or_default(), options.force)?;
                let pending = match &mut sweeps {
                    Some(pending) => pending,
                    none => {
                        let request = asked.job_request(options.clone(), Durability::Durable);
                        none.insert(PendingJob::begin(service, caller.clone(), request)?)
                    }
                };
                let index = pending.sweeps();
                let (cloud, room) = body.sweep(index, name, bytes, poses.as_ref()).await?;
                pending.push(cloud, Some(room)).await?;
            }
            Part::File(part, name, bytes) => files.take(&part, name, bytes)?,
        }
    }
    match sweeps {
        Some(_) if !files.is_empty() => {
            let text = "send source and target, or sweeps, but not both";
            Err(ApiError::BadRequest(text.to_owned()))
        }
        Some(pending) => {
            if let Some(poses) = poses {
                let counted = poses.check_count(pending.sweeps() as usize);
                counted.map_err(bad_poses)?;
            }
            Ok((pending, Kind::Sequence))
        }
        None if poses.is_some() => Err(poses_of_a_pair()),
        None => {
            options.check_for_pairs()?;
            let request = asked.job_request(options, Durability::Durable);
            let mut pending = PendingJob::begin(service, caller.clone(), request)?;
            files.push_to(body, &mut pending).await?;
            Ok((pending, Kind::Pair))
        }
    }
}

/// The 202 response with the location of the job.
async fn accepted(service: &Service, job: &Arc<Job>, prefer: Prefer) -> Response {
    // The job is accepted, even where the queue cannot be asked now.
    let wait = service.waiting(job).await.unwrap_or_default();
    let view = JobView::new(job, &[]).with_wait(wait);
    let mut response = (StatusCode::ACCEPTED, Json(view)).into_response();
    let headers = response.headers_mut();
    let mut set = |name: &'static str, value: String| {
        if let Ok(value) = HeaderValue::from_str(&value) {
            headers.insert(name, value);
        }
    };
    set("location", view::path(job));
    set("fnsf-job-id", job.id.to_string());
    if let Some(applied) = prefer.applied() {
        set("preference-applied", applied);
    }
    response
}

/// The query parameters of a job request.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Look {
    /// Seconds to wait for the end of the job, at most 60.
    wait: Option<u64>,
}

/// Returns a job. With `wait` the response is delayed until the job ends or the timeout passes.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}",
    tag = "jobs",
    params(("id" = String, Path, description = "The job's name"), ("wait" = Option<u64>, Query, description = "Seconds to wait for its end, at most 60")),
    responses(
        (status = 200, description = "The job", body = JobView),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn get_job(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
    look: Result<Query<Look>, axum::extract::rejection::QueryRejection>,
) -> Result<Json<JobView>, ApiError> {
    let Query(look) = look.map_err(|error| ApiError::BadRequest(error.body_text()))?;
    let mut job = service.job(&caller, id).await?;
    if let Some(seconds) = look.wait
        && !job.state.is_end()
    {
        let longest = Duration::from_secs(seconds).min(MAX_POLL);
        job = match service.wait(job.id, Some(longest)).await? {
            Waited::Ended(job) | Waited::StillOpen(job) => job,
        };
    }
    let pairs = service.pairs(&job).await?;
    let wait = service.waiting(&job).await?;
    Ok(Json(
        JobView::shown_to(&caller, &job, &pairs).with_wait(wait),
    ))
}

/// The query parameters of a cancellation.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Deletion {
    /// Whether to remove the job, which must have ended, instead of cancelling it.
    #[serde(default)]
    remove: bool,
}

/// Cancels a job: at once if it is queued, within an iteration if it is running. An ended job is not
/// changed. With `remove=true` it is removed, with its sweeps and its result.
#[utoipa::path(
    delete,
    path = "/v1/jobs/{id}",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "The job's name"),
        ("remove" = Option<bool>, Query, description = "Remove the job, which must have ended, instead of cancelling it"),
    ),
    responses(
        (status = 200, description = "The job; its end is asked for", body = JobView),
        (status = 204, description = "The job is removed"),
        (status = 400, description = "A pair of a sequence is not removed alone", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "A job that has not ended is not removed", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn delete_job(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
    deletion: Result<Query<Deletion>, axum::extract::rejection::QueryRejection>,
) -> Result<Response, ApiError> {
    let Query(deletion) = deletion.map_err(|error| ApiError::BadRequest(error.body_text()))?;
    if deletion.remove {
        service.remove(&caller, id).await?;
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let job = service.cancel(&caller, id).await?;
    Ok(Json(JobView::new(&job, &[])).into_response())
}

/// Queues a job again that failed, expired or was cancelled, or whose result is lost. For a
/// sequence, the pairs that did not succeed, or that a deadline stopped early, are queued again.
#[utoipa::path(
    post,
    path = "/v1/jobs/{id}/requeue",
    tag = "jobs",
    params(("id" = String, Path, description = "The job's name")),
    responses(
        (status = 200, description = "The job, queued", body = JobView),
        (status = 400, description = "It has not ended, or has succeeded", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn requeue_job(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
) -> Result<Json<JobView>, ApiError> {
    let job = service.requeue(&caller, id).await?;
    Ok(Json(JobView::new(&job, &[])))
}
