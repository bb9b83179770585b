//! The JSON representation of a job.

use std::sync::Arc;

use serde::Serialize;
use serde_json::value::{RawValue, Value};
use utoipa::ToSchema;

use crate::api::auth::Caller;
use crate::api::waiting::Waiting;
use crate::job::{DeliveryState, Job, JobError, JobProgress, Kind, State};

/// A job.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobView {
    /// The job id, a UUID.
    id: String,
    /// The state of the job.
    state: State,
    /// A pair or a sequence.
    kind: Kind,
    /// When the job was accepted: RFC 3339, UTC. All times have this format.
    created_at: String,
    /// When the job was first started.
    started_at: Option<String>,
    /// When the job ended.
    finished_at: Option<String>,
    /// The deadline. A running job then returns its best flow so far; a queued job expires.
    deadline: Option<String>,
    /// The number of times that the job was started.
    attempt: u32,
    /// The progress of the estimate.
    progress: Option<JobProgress>,
    /// How long the job waits. Only present when a single queued job is requested or accepted.
    #[serde(skip_serializing_if = "Option::is_none")]
    wait: Option<Waiting>,
    /// Where the result is delivered to, if the job has a `result_uri`.
    #[serde(skip_serializing_if = "Option::is_none")]
    delivery: Option<DeliveryView>,
    /// Why the estimate stopped: `completed`, `converged`, `max_iterations` or `deadline`.
    stop_reason: Option<String>,
    /// Why the job failed.
    error: Option<JobError>,
    /// Whether the job was given up after too many attempts. POST to `links.requeue` to run it
    /// again.
    dead_letter: bool,
    /// The options of the submission.
    #[schema(value_type = Object)]
    options: Option<Box<RawValue>>,
    /// The report on the estimate. For a sequence with `densify`, the report on its dense cloud.
    #[schema(value_type = Option<Reported>)]
    report: Option<Box<RawValue>>,
    /// The id of the trace of the request that submitted the job.
    trace_id: Option<String>,
    /// The pairs of a sequence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pairs: Option<PairsView>,
    /// Related resources.
    links: Links,
}

/// The report of a job.
#[derive(Serialize, ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "it describes what is kept as JSON")]
enum Reported {
    Flow(Box<crate::job::Report>),
    Cloud(crate::job::DenseReport),
}

/// The delivery of a result.
#[derive(Debug, Serialize, ToSchema)]
struct DeliveryView {
    /// The URI of the object.
    uri: String,
    /// How far the delivery is.
    state: DeliveryState,
}

/// The pairs of a sequence, and its progress.
#[derive(Debug, Serialize, ToSchema)]
struct PairsView {
    /// The number of pairs, including the backward pairs of `densify`.
    total: u32,
    /// The number of pairs that have ended.
    ended: u32,
    /// The jobs of the consecutive pairs, in order. Only present when a single job is requested.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    jobs: Vec<PairView>,
}

/// A pair of a sequence.
#[derive(Debug, Serialize, ToSchema)]
struct PairView {
    /// The job id of the pair, a UUID.
    id: String,
    /// The state of the pair's job.
    state: State,
    /// The path of the pair's flow.
    result: String,
}

/// The paths of related resources.
#[derive(Debug, Serialize, ToSchema)]
struct Links {
    /// The job.
    #[serde(rename = "self")]
    this: String,
    /// The job's events, as server-sent events (GET).
    events: String,
    /// The job's result (GET).
    result: String,
    /// Queues the job again (POST).
    requeue: String,
}

/// The path of a job.
pub(super) fn path(job: &Job) -> String {
    format!("/v1/jobs/{}", job.id)
}

/// The options as a caller may see them: a webhook's URL may hold a secret of who submitted the job.
/// Labels and places of results are not for who has a link to it.
fn options_for(caller: &Caller, options: &str) -> Option<Box<RawValue>> {
    let mut shown: serde_json::Map<String, Value> = serde_json::from_str(options).ok()?;
    shown.remove("webhook");
    if caller.shared_job.is_some() {
        shown.remove("labels");
        shown.remove("result_uri");
    }
    serde_json::value::to_raw_value(&shown).ok()
}

impl JobView {
    /// The representation of a job as this caller may see it.
    pub(super) fn shown_to(caller: &Caller, job: &Job, pairs: &[Arc<Job>]) -> Self {
        let mut view = Self::new(job, pairs);
        if caller.may_write().is_err() {
            view.options = options_for(caller, &job.options);
        }
        if caller.shared_job.is_some() {
            view.delivery = None;
        }
        view
    }

    /// The representation with the time that the job waits.
    pub(super) fn with_wait(self, wait: Option<Waiting>) -> Self {
        Self { wait, ..self }
    }

    /// The representation of a job. `pairs` are the pairs to include for a sequence.
    pub(super) fn new(job: &Job, pairs: &[Arc<Job>]) -> Self {
        let raw = |text: &str| RawValue::from_string(text.to_owned()).ok();
        let this = path(job);
        let pair = |pair: &Arc<Job>| PairView {
            id: pair.id.to_string(),
            state: pair.state,
            result: format!("{}/result", path(pair)),
        };
        Self {
            id: job.id.to_string(),
            state: job.state,
            kind: job.kind,
            created_at: job.created.to_string(),
            started_at: job.started.map(|moment| moment.to_string()),
            finished_at: job.finished.map(|moment| moment.to_string()),
            deadline: job.deadline.map(|moment| moment.to_string()),
            attempt: job.attempt,
            progress: job.progress,
            wait: None,
            delivery: job.delivery.as_ref().map(|delivery| DeliveryView {
                uri: delivery.uri.clone(),
                state: delivery.state,
            }),
            stop_reason: job.stop_reason.clone(),
            error: job.error.clone(),
            dead_letter: job.dead,
            options: raw(&job.options),
            report: job.report.as_deref().and_then(raw),
            trace_id: job.trace_id().map(str::to_owned),
            pairs: (job.kind == Kind::Sequence).then(|| PairsView {
                total: job.pairs,
                ended: job.pairs - job.pairs_left,
                jobs: pairs.iter().map(pair).collect(),
            }),
            links: Links {
                events: format!("{this}/events"),
                result: format!("{this}/result"),
                requeue: format!("{this}/requeue"),
                this,
            },
        }
    }
}
