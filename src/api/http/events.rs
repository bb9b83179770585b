//! Job events as server-sent events, until the job ends.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::{Extension, State};
use axum::http::{HeaderMap, header};
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::Stream;
use futures_util::stream;

use super::named::Named;
use super::problem::Problem;
use super::view::JobView;
use crate::api::auth::Caller;
use crate::api::error::ApiError;
use crate::api::job_watch::JobWatch;
use crate::api::service::Service;
use crate::job::State as JobState;

/// Interval of keep-alive comments, so that proxies do not close an idle stream.
const HEARTBEAT: Duration = Duration::from_secs(15);

/// The state of an event stream.
struct Told {
    watch: JobWatch,
    last: Option<(JobState, u32, u32)>,
    ended: bool,
}

/// Streams the state changes and the progress of a job as server-sent events.
///
/// A `state` event contains the job, a `progress` event its progress. The stream begins with the
/// current state of the job, so a client can reconnect at any time. It ends when the job ends, when
/// the key or the link of the reader is no longer valid, or when the server shuts down.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/events",
    tag = "jobs",
    params(("id" = String, Path, description = "The job's name")),
    responses(
        (status = 200, description = "Events", content_type = "text/event-stream"),
        (status = 404, description = "No such job", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn follow_job(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
    headers: HeaderMap,
) -> Result<Sse<impl Stream<Item = Result<Event, Infallible>>>, ApiError> {
    let shown = headers.get(header::AUTHORIZATION);
    let shown = shown.and_then(|value| value.to_str().ok());
    let watch = JobWatch::begin(&service, &caller, shown, id).await?;
    let told = Told {
        watch,
        last: None,
        ended: false,
    };
    let events = stream::unfold(told, next);
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(HEARTBEAT)))
}

/// The next event. `None` after the end of the job, or when the subscription ends.
async fn next(mut told: Told) -> Option<(Result<Event, Infallible>, Told)> {
    if told.ended {
        return None;
    }
    if told.last.is_some() {
        told.watch.changed().await.ok()?;
    }
    let job = told.watch.latest();
    let now = (job.state, job.attempt, job.pairs_left);
    let same_state = told.last == Some(now);
    told.last = Some(now);
    told.ended = job.state.is_end();
    let iteration = job.progress.map_or(0, |progress| progress.done);
    let id = format!("{}.{iteration}", job.attempt);
    let event = match job.progress {
        Some(progress) if same_state => Event::default().event("progress").json_data(progress),
        _ => Event::default().event("state").json_data(JobView::shown_to(
            &told.watch.caller,
            &job,
            &[],
        )),
    };
    let event = event.unwrap_or_default().id(id);
    Some((Ok(event), told))
}
