//! The record of a job, and its states.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::choices::Priority;
use super::delivery::Delivery;
use super::device::DeviceKind;
use super::id::{JobId, Tenant};
use crate::clock::Timestamp;
use crate::flow::StopReason;

/// The state of a job. The last four are final: only a requeue leaves them.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Not started: it waits for a device, for the pair before it, or for a retry.
    Queued,
    /// A device computes it. A sequence is running from the start of its first pair, and is queued
    /// again once only its dense cloud is left to compute.
    Running,
    /// All its work is done, and the result was stored.
    Succeeded,
    /// The job failed permanently or reached the maximum number of attempts.
    Failed,
    /// Cancelled by a client, or its waiting caller disconnected.
    Cancelled,
    /// The deadline or the time to live passed before the job started.
    Expired,
}

impl State {
    /// All states.
    pub const ALL: [Self; 6] = [
        Self::Queued,
        Self::Running,
        Self::Succeeded,
        Self::Failed,
        Self::Cancelled,
        Self::Expired,
    ];

    /// Whether the state is final.
    pub fn is_end(self) -> bool {
        !matches!(self, Self::Queued | Self::Running)
    }

    /// The name in responses and metrics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Expired => "expired",
        }
    }
}

/// The kind of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// One pair of sweeps.
    Pair,
    /// A sequence of sweeps. Each pair of consecutive sweeps is a separate job.
    Sequence,
}

/// Progress of the computation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, ToSchema)]
pub struct JobProgress {
    /// Finished iterations of a field's fit, or finished clusters of an object search.
    pub done: u32,
    /// Maximum number of iterations, or number of clusters.
    pub total: u32,
    /// Loss in metres. During a fit it is the mean over the points of the latest iteration; at its
    /// end it is that of the best iteration. For an object search it is the mean cost of the
    /// finished clusters.
    pub loss: f64,
}

/// Why a job did not succeed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct JobError {
    /// A stable code for programs.
    pub code: String,
    /// A message for people.
    pub message: String,
    /// Whether a retry of the same job may succeed.
    pub retryable: bool,
}

/// A job as the queue stores it.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// Its id.
    pub id: JobId,
    /// The tenant that owns it.
    pub tenant: Tenant,
    /// A pair or a sequence.
    pub kind: Kind,
    /// The sequence that the pair belongs to. None for a sequence, for a single pair and for a pair
    /// of a stream.
    pub parent: Option<JobId>,
    /// Index of the earlier of its two sweeps, from 0: in its sequence, or, for a pair of a stream,
    /// among the sweeps that are stored with the job.
    pub index: u32,
    /// Whether the pair is backward in time: its source is the later sweep.
    pub backward: bool,
    /// The window of sweeps that the estimate uses: the first index, and one past the last.
    pub window: [u32; 2],
    /// Number of pairs of a sequence, backward pairs included; 0 for a pair.
    pub pairs: u32,
    /// Number of pairs of a sequence that have not ended; 0 for a pair.
    pub pairs_left: u32,
    /// The job that must end, with or without success, before this one starts.
    pub after: Option<JobId>,
    /// Whether the motion field of the result is stored for the next pair of the chain, which may
    /// start from it (warm start). True for every pair of a streamed chain, because its end is not
    /// known.
    pub has_dependents: bool,
    /// Time since which the job waits only for a free device. None while the job in `after` has not
    /// ended. For a sequence it is set when only its dense cloud is left to compute.
    pub ready: Option<Timestamp>,
    /// The priority.
    pub priority: Priority,
    /// The required kind of device; none if any kind will do.
    pub device: Option<DeviceKind>,
    /// The state.
    pub state: State,
    /// Whether the job continues when its caller disconnects: true for a submitted job, false for a
    /// synchronous call.
    pub durable: bool,
    /// Number of starts, requeues included. It is also the fencing token of the latest start.
    pub attempt: u32,
    /// Crashes of the process or the device during the job, since its latest snapshot.
    pub crashes: u32,
    /// Predicted compute time in nominal seconds, which [`CostModel`](crate::cost::CostModel)
    /// converts to seconds on this machine. For a sequence: that of its dense cloud alone, 0
    /// without one.
    pub cost_seconds: f64,
    /// The options, a [`JobOptions`](super::JobOptions), as JSON.
    pub options: String,
    /// Time of acceptance.
    pub created: Timestamp,
    /// Time of the first start since the job was submitted or requeued by a client. None before it.
    pub started: Option<Timestamp>,
    /// Time of the end. None before it.
    pub finished: Option<Timestamp>,
    /// Time by which the best flow so far is to be returned. None without a deadline.
    pub deadline: Option<Timestamp>,
    /// The latest known progress. None before the first report of progress, and for a sequence.
    pub progress: Option<JobProgress>,
    /// Why the estimate of a pair ended: `completed`, `converged`, `max_iterations` or `deadline`.
    pub stop_reason: Option<String>,
    /// Why the job did not succeed. None before the end, and of a job that succeeded.
    pub error: Option<JobError>,
    /// Whether it is a dead letter: given up after too many attempts or crashes.
    pub dead: bool,
    /// Whether its cancellation was requested.
    pub cancel_requested: bool,
    /// The report as JSON: a [`Report`](super::Report), or a [`DenseReport`](super::DenseReport) of
    /// a sequence with a dense cloud. None before success, and for other sequences.
    pub report: Option<String>,
    /// The span of the request that submitted the job, as the value of a `traceparent` header (W3C
    /// Trace Context). None if the request belongs to no trace.
    pub trace: Option<String>,
    /// The URL that is told of the job's end. None for the pairs of a sequence.
    pub webhook: Option<String>,
    /// The delivery of its result. None if it stays here.
    pub delivery: Option<Delivery>,
}

impl Job {
    /// The id of the trace that the job belongs to, 32 hexadecimal digits.
    pub fn trace_id(&self) -> Option<&str> {
        self.trace.as_deref()?.split('-').nth(1)
    }

    /// Whether a deadline stopped it before its flow was as good as it could be.
    pub fn is_cut_short(&self) -> bool {
        self.stop_reason.as_deref() == Some(StopReason::Deadline.name())
    }

    /// For a pair: the job that owns its stored sweeps, and the indices of its source and its
    /// target among them. For a sequence the first value is its own id, and the indices have no
    /// meaning.
    pub fn sweeps(&self) -> (JobId, [u32; 2]) {
        let owner = self.parent.unwrap_or(self.id);
        match self.backward {
            false => (owner, [self.index, self.index + 1]),
            true => (owner, [self.index + 1, self.index]),
        }
    }
}
