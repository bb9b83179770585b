//! What a webhook is told of a job.

use serde::Serialize;

use super::labels::Labels;
use super::record::{Job, JobError, Kind, State};

/// The body of a notice. Its form is that of [Standard Webhooks](https://www.standardwebhooks.com):
/// a type, a time and data.
#[derive(Serialize)]
struct Notice<'a> {
    #[serde(rename = "type")]
    kind: String,
    timestamp: String,
    data: Data<'a>,
}

#[derive(Serialize)]
struct Data<'a> {
    id: String,
    tenant: &'a str,
    kind: Kind,
    state: State,
    labels: Labels,
    stop_reason: Option<&'a str>,
    error: Option<&'a JobError>,
    dead_letter: bool,
    /// The path of the job below the service's own address.
    path: String,
}

/// The notice of a job's end, as JSON: type `job.` and the state, the time of the end, and the job's
/// id, tenant, kind, state, labels, stop reason, error and path.
pub fn ended_notice(job: &Job) -> String {
    let notice = Notice {
        kind: format!("job.{}", job.state.name()),
        timestamp: job.finished.map(|at| at.to_string()).unwrap_or_default(),
        data: Data {
            id: job.id.to_string(),
            tenant: job.tenant.as_str(),
            kind: job.kind,
            state: job.state,
            labels: Labels::of_options(&job.options),
            stop_reason: job.stop_reason.as_deref(),
            error: job.error.as_ref(),
            dead_letter: job.dead,
            path: format!("/v1/jobs/{}", job.id),
        },
    };
    serde_json::to_string(&notice).expect("text and names have a JSON form")
}
