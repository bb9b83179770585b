//! A job as JSON.

use std::sync::Arc;

use serde::Serialize;
use serde_json::value::RawValue;
use utoipa::ToSchema;

use crate::job::{Job, JobError, JobProgress, Kind, State};

/// A job, as the contract shows it.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobView {
    /// Its name, a UUID.
    id: String,
    state: State,
    kind: Kind,
    /// RFC 3339, UTC, like the other moments.
    created_at: String,
    started_at: Option<String>,
    finished_at: Option<String>,
    /// When the best flow so far is wanted.
    deadline: Option<String>,
    /// How often it was started.
    attempt: u32,
    progress: Option<JobProgress>,
    /// `converged`, `max_iterations` or `deadline`.
    stop_reason: Option<String>,
    error: Option<JobError>,
    /// Given up after too many attempts; POST to links.requeue tries again.
    dead_letter: bool,
    /// The options that it was submitted with.
    #[schema(value_type = Object)]
    options: Option<Box<RawValue>>,
    /// How the flow was found; of a sequence with `densify`, how its cloud was made.
    #[schema(value_type = Option<Reported>)]
    report: Option<Box<RawValue>>,
    /// The pairs of a sequence, in order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pairs: Option<PairsView>,
    links: Links,
}

/// What a report is.
#[derive(Serialize, ToSchema)]
#[serde(untagged)]
#[expect(dead_code, reason = "it describes what is kept as JSON")]
enum Reported {
    Flow(Box<crate::job::Report>),
    Cloud(crate::job::DenseReport),
}

/// How far a sequence has come.
#[derive(Debug, Serialize, ToSchema)]
struct PairsView {
    /// All of them, those that `densify` has fitted backward in time included.
    total: u32,
    /// Those that have ended.
    ended: u32,
    /// The consecutive pairs' jobs, in order, where a single job is shown.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    jobs: Vec<PairView>,
}

/// A pair of a sequence.
#[derive(Debug, Serialize, ToSchema)]
struct PairView {
    id: String,
    state: State,
    /// Where its own result is.
    result: String,
}

/// Where to go from here.
#[derive(Debug, Serialize, ToSchema)]
struct Links {
    #[serde(rename = "self")]
    this: String,
    events: String,
    result: String,
    requeue: String,
}

/// The path of a job.
pub(super) fn path(job: &Job) -> String {
    format!("/v1/jobs/{}", job.id)
}

impl JobView {
    /// The view of a job; `pairs` are those of a sequence, where they are wanted.
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
            stop_reason: job.stop_reason.clone(),
            error: job.error.clone(),
            dead_letter: job.dead,
            options: raw(&job.options),
            report: job.report.as_deref().and_then(raw),
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
