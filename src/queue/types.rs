//! Arguments, results, errors and events of the queue.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobError, JobId, JobProgress, Kind, Priority, State, Tenant};

/// A job to be accepted.
#[derive(Clone, Debug)]
pub struct Submission {
    /// Its id, which no other job has. The payload is already stored under it.
    pub id: JobId,
    /// The tenant that owns it.
    pub tenant: Tenant,
    /// A pair or a sequence.
    pub kind: Kind,
    /// The sweeps of a pair; ignored for a sequence.
    pub pair: PairOf,
    /// The pairs of a sequence, in the order of their execution; empty for a pair.
    pub pairs: Vec<PairOf>,
    /// Predicted compute time of a sequence's closing job, nominal seconds ([`crate::cost`]). It
    /// runs when all of the pairs have succeeded. `None` if there is no closing job. Ignored for a
    /// pair.
    pub finalizer_seconds: Option<f64>,
    /// The job that must end, in any state, before this pair is started. An unknown job does not
    /// delay it. Must be `None` for a sequence, whose order [`PairOf::chained`] gives.
    pub after: Option<JobId>,
    /// Whether another job may follow this pair and use its motion field, which is then stored.
    /// Ignored for a sequence.
    pub has_dependents: bool,
    /// Its priority.
    pub priority: Priority,
    /// The kind of device that it requires; `None` for any.
    pub device: Option<DeviceKind>,
    /// Predicted compute time of a pair, or of each pair of a sequence, nominal seconds
    /// ([`crate::cost`]). Must be finite and at least 0.
    pub cost_seconds: f64,
    /// The options, as JSON; opaque to the queue.
    pub options: String,
    /// Texts by which [`Queue::list`](super::Queue::list) finds the job. Of a sequence, they are
    /// not those of its pairs.
    pub labels: Vec<String>,
    /// The span of the request, as the value of a `traceparent` header. `None` without a trace.
    pub trace: Option<String>,
    /// The URL that is told of the job's end, by an [`Outgoing`](super::Outgoing) action. Of a
    /// sequence, it is not told of the pairs.
    pub webhook: Option<String>,
    /// The URI that the result is delivered to, by an [`Outgoing`](super::Outgoing) action. Of a
    /// sequence, it is that of the closing job or, with [`PAIR_INDEX`](crate::job::PAIR_INDEX) in
    /// it, those of the forward pairs.
    pub result_uri: Option<String>,
    /// Time at which the best flow so far is returned. A job that is still queued then expires. It
    /// does not apply to a closing job. `None`: [`QueueOptions::time_to_live`] limits the wait.
    pub deadline: Option<Timestamp>,
    /// Idempotency key and fingerprint. A submission of the same tenant with the same key and
    /// fingerprint returns the existing job; with another fingerprint it fails with
    /// [`QueueError::KeyReused`]. The key of an ephemeral job that ended without success, or whose
    /// cancellation was requested, is free again. `None`: always a new job.
    pub idempotency: Option<Idempotency>,
    /// Whether the job survives this process. A job that is not durable is ephemeral: the next
    /// start of the queue removes it if it has not ended.
    pub durable: bool,
}

impl Submission {
    /// A durable job of a single pair under a new id: any device, normal priority, no cost, no
    /// options, no deadline and no idempotency key.
    pub(super) fn pair(tenant: Tenant) -> Self {
        Self {
            id: JobId::fresh(),
            tenant,
            kind: Kind::Pair,
            pair: PairOf::ALONE,
            pairs: Vec::new(),
            finalizer_seconds: None,
            after: None,
            has_dependents: false,
            priority: Priority::Normal,
            device: None,
            cost_seconds: 0.0,
            options: String::new(),
            labels: Vec::new(),
            trace: None,
            webhook: None,
            result_uri: None,
            deadline: None,
            idempotency: None,
            durable: true,
        }
    }
}

/// The sweeps of a pair, as indices into the sweeps stored under its own id or its sequence's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PairOf {
    /// Index of the earlier of its two sweeps.
    pub index: u32,
    /// Whether the flow goes backward in time, from the later sweep to the earlier one.
    pub backward: bool,
    /// The half-open range of sweeps used for the estimate, including its own two: first, and one
    /// past the last.
    pub window: [u32; 2],
    /// Whether it is started only after the end of the pair before it in [`Submission::pairs`].
    /// Ignored for the first of them and for a single pair.
    pub chained: bool,
}

impl PairOf {
    /// The pair of sweeps 0 and 1: forward in time, without neighbors, not chained.
    pub const ALONE: Self = Self {
        index: 0,
        backward: false,
        window: [0, 2],
        chained: false,
    };

    /// Converts a range of sweep indices to the form of [`PairOf::window`]. Indices beyond
    /// `u32::MAX` become `u32::MAX`.
    pub fn seen(sweeps: Range<usize>) -> [u32; 2] {
        [sweeps.start, sweeps.end].map(|index| u32::try_from(index).unwrap_or(u32::MAX))
    }
}

/// Identifies a repeated submission.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Idempotency {
    /// The caller's key, unique per tenant.
    pub key: String,
    /// Hash of payload and options, computed by the caller. The same key with another fingerprint
    /// is refused, see [`Submission::idempotency`].
    pub fingerprint: [u8; 32],
}

/// The result of a submission.
#[derive(Clone, Debug)]
pub enum Submitted {
    /// The job was accepted.
    New(Arc<Job>),
    /// The idempotency key belongs to this job, which was accepted before; no job was added.
    Known(Arc<Job>),
}

/// Selects the jobs to list, latest first.
#[derive(Clone, Debug)]
pub struct Filter {
    /// The tenant that owns them.
    pub tenant: Tenant,
    /// Their state; `None` for any.
    pub state: Option<State>,
    /// A label that they have; `None` for any.
    pub label: Option<String>,
    /// Only jobs whose id is less than this one, so that they were created earlier. It need not be
    /// the id of a job. `None` for all jobs.
    pub before: Option<JobId>,
    /// Maximum number of jobs, of which at most 1000 are returned.
    pub limit: u32,
}

/// How an attempt ended.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// The result is stored under this attempt.
    Succeeded {
        /// The name of the [`crate::flow::StopReason`]; `None` for a dense cloud.
        stop_reason: Option<String>,
        /// The report of the estimate or of the dense cloud, as JSON.
        report: String,
        /// The final progress, if there is one.
        progress: Option<JobProgress>,
    },
    /// It failed. A job with a retryable failure is requeued after [`QueueOptions::retry_delay`],
    /// and becomes a dead letter at failure number [`QueueOptions::max_attempts`]. Another failure
    /// ends the job at once.
    Failed(JobError),
    /// The worker stopped because of a cancellation.
    Cancelled,
    /// The worker released the job through no fault of the job. It is requeued unchanged.
    Released,
    /// The store works but fails for this job. The job is requeued with a delay, and becomes a dead
    /// letter the 13th time. The first delay is twice the larger of 0.5 s and
    /// [`QueueOptions::retry_delay`]. It doubles each time, up to 300 s.
    Delayed(JobError),
    /// The job does not fit this device. It is requeued and now requires this kind.
    Moved(DeviceKind),
    /// The device was lost during the attempt, perhaps through another job. The job is requeued at
    /// once, and becomes a dead letter at crash number [`QueueOptions::max_crashes`].
    Crashed(JobError),
}

/// The result of finishing an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Committed {
    /// The outcome was stored. The value is the job's new state.
    Yes(State),
    /// The attempt no longer holds the job, or the job has ended or is unknown. The outcome is
    /// discarded.
    Fenced,
}

/// Timeouts, limits and retention of the queue.
#[derive(Clone, Debug)]
pub struct QueueOptions {
    /// Number of retryable failures at which a job becomes a dead letter; 0 counts as 1. A failure
    /// that is not retryable ends the job at once.
    pub max_attempts: u32,
    /// Number of crashes of the process or of a device during a job's run, counted since its last
    /// snapshot, at which the job becomes a dead letter; 0 counts as 1.
    pub max_crashes: u32,
    /// Time without a heartbeat after which a running job loses its lease. It counts as a retryable
    /// failure.
    pub lease: Duration,
    /// Delay after the first retryable failure of a job. It doubles with each further failure, up
    /// to 1024 times the first delay.
    pub retry_delay: Duration,
    /// Time after its submission or [`Queue::requeue`](super::Queue::requeue) at which a job
    /// without a deadline expires if it is queued then. For a closing job the time starts when all
    /// pairs have succeeded.
    pub time_to_live: Duration,
    /// Time for which an ended durable job and its result are kept. They are kept for longer while
    /// a job that follows has not ended.
    pub retention: Duration,
    /// The same for an ended ephemeral job, whose caller waited for the result.
    pub answered_retention: Duration,
}

impl Default for QueueOptions {
    /// 3 failures, 5 crashes, a lease of 60 s, a retry delay of 1 s, a time to live of 7 days, a
    /// retention of 24 h, and an answered retention of 60 s.
    fn default() -> Self {
        Self {
            max_attempts: 3,
            max_crashes: 5,
            lease: Duration::from_secs(60),
            retry_delay: Duration::from_secs(1),
            time_to_live: Duration::from_secs(7 * 24 * 3600),
            retention: Duration::from_secs(24 * 3600),
            answered_retention: Duration::from_secs(60),
        }
    }
}

/// Errors of the queue.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum QueueError {
    /// No such job, or it belongs to another tenant.
    #[error("no job has this name")]
    NotFound,
    /// The idempotency key was used by this job, with another payload or other options.
    #[error("the idempotency key was used with another payload, by job {0}")]
    KeyReused(JobId),
    /// The job cannot be requeued: it has not ended, or it has succeeded and its result is not
    /// lost. The value is its state.
    #[error("only a job that failed, expired or was cancelled is queued again: this one is {}", .0.name())]
    NotTerminal(State),
    /// The job cannot be removed: it has not ended. The value is its state.
    #[error("only a job that has ended is removed: this one is {}", .0.name())]
    NotEnded(State),
    /// The job cannot be removed: it is a pair of this sequence.
    #[error("the job is a pair of sequence {0}, which is removed as a whole")]
    PairOfSequence(JobId),
    /// The ephemeral job is being cancelled or was cancelled, and cannot become durable.
    #[error("the job is being cancelled")]
    GivenUp,
    /// The store failed, with the reason: a fault of the machine, not of a job.
    #[error("the queue's store failed: {0}")]
    Store(String),
    /// The store cannot grow because the disk is full: a fault of the machine.
    #[error("the queue's store is full: {0}")]
    Full(String),
    /// The writer of the queue has ended. Only a new process can write again.
    #[error("the queue is closed")]
    Closed,
}

impl QueueError {
    /// Whether the machine is at fault, so that a retry may succeed: [`QueueError::Store`] or
    /// [`QueueError::Full`].
    pub fn is_of_the_machine(&self) -> bool {
        matches!(self, Self::Store(_) | Self::Full(_))
    }
}

/// An event of the queue, for the metrics.
#[derive(Clone, Debug)]
pub enum Event {
    /// A job was accepted. A sequence sends it for each pair and for itself.
    Submitted(Arc<Job>),
    /// A job was leased for the first time.
    Started(Arc<Job>),
    /// A job was requeued: by the outcome of an attempt, an expired lease, the recovery, or
    /// [`Queue::requeue`](super::Queue::requeue). If that call requeues a sequence, each requeued
    /// pair sends it. The sequence itself then sends it only if none of its pairs is requeued.
    Requeued(Arc<Job>),
    /// The lease of this job expired. Not sent if its cancellation was requested: such a job ends
    /// as cancelled.
    LeaseExpired(JobId),
    /// A job ended. A sequence sends it for each pair and for itself. An ephemeral job that the
    /// recovery removes before its end does not send it.
    Ended(Arc<Job>),
    /// A job was removed from the queue. Its files are removed by an [`Outgoing`](super::Outgoing)
    /// action.
    Deleted(JobId),
}
