//! The interface of the queue: the `Queue` trait, its arguments, results, errors and events.

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::watch;

use super::backlog::Backlog;
use super::lease::Lease;
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobError, JobId, JobProgress, Kind, Priority, State, Tenant};

/// A job to be accepted.
#[derive(Clone, Debug)]
pub struct Submission {
    /// Its id. The payload is already stored under it.
    pub id: JobId,
    /// The tenant that owns it.
    pub tenant: Tenant,
    /// A pair or a sequence.
    pub kind: Kind,
    /// The sweeps of a pair; ignored for a sequence.
    pub pair: PairOf,
    /// The pairs of a sequence, in the order of their execution; empty for a pair.
    pub pairs: Vec<PairOf>,
    /// Predicted compute seconds of a sequence's closing job, which runs when all of its pairs have
    /// succeeded; `None` if there is no closing job.
    pub finalizer_seconds: Option<f64>,
    /// The job that must end, in any state, before this one is started.
    pub after: Option<JobId>,
    /// Whether another job may follow this one and use its field.
    pub has_dependents: bool,
    /// Its priority.
    pub priority: Priority,
    /// The kind of device that it requires; `None` for any.
    pub device: Option<DeviceKind>,
    /// Predicted compute seconds, per pair.
    pub cost_seconds: f64,
    /// The options, as JSON; opaque to the queue.
    pub options: String,
    /// Time at which the best flow so far is returned. A job that is still queued then expires.
    pub deadline: Option<Timestamp>,
    /// Idempotency key and fingerprint. A submission of the same tenant with the same key and
    /// fingerprint returns the existing job; with another fingerprint it fails with
    /// [`QueueError::KeyReused`]. The key of an ephemeral job that ended without success, or whose
    /// cancellation was requested, is free again. None: always a new job.
    pub idempotency: Option<Idempotency>,
    /// Whether the job survives this process. An ephemeral job ends with the process.
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
    /// Whether it follows the pair before it in the list.
    pub chained: bool,
}

impl PairOf {
    /// A single pair of sweeps without neighbors.
    pub const ALONE: Self = Self {
        index: 0,
        backward: false,
        window: [0, 2],
        chained: false,
    };

    /// A range of sweeps in the form of [`PairOf::window`].
    pub fn seen(sweeps: Range<usize>) -> [u32; 2] {
        [sweeps.start, sweeps.end].map(|index| u32::try_from(index).unwrap_or(u32::MAX))
    }
}

/// Identifies a repeated submission.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Idempotency {
    /// The caller's key, unique per tenant.
    pub key: String,
    /// Hash of payload and options. The same key with another fingerprint is an error.
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
    /// Only jobs older than this one.
    pub before: Option<JobId>,
    /// Maximum number of jobs.
    pub limit: u32,
}

/// How an attempt ended.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// The result is stored under this attempt.
    Succeeded {
        /// Why the optimization stopped, if there was one.
        stop_reason: Option<String>,
        /// The solver's report, as JSON.
        report: String,
        /// The final progress, if there was an iteration.
        progress: Option<JobProgress>,
    },
    /// It failed. A retryable failure is retried while attempts are left.
    Failed(JobError),
    /// The worker stopped because of a cancellation.
    Cancelled,
    /// The worker released the job through no fault of the job. It is requeued unchanged.
    Released,
    /// The store works but fails for this job. It is requeued with a delay that grows each time,
    /// and becomes a dead letter after a fixed number of these.
    Delayed(JobError),
    /// The job does not fit this device. It is requeued and now requires this kind.
    Moved(DeviceKind),
    /// The device was lost during the attempt, perhaps through another job. The job is requeued,
    /// and becomes a dead letter after [`QueueOptions::max_crashes`].
    Crashed(JobError),
}

/// The result of finishing an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Committed {
    /// The outcome was stored; the job's new state.
    Yes(State),
    /// The attempt no longer holds the job, or the job has ended. The outcome is discarded.
    Fenced,
}

/// Timeouts, limits and retention of the queue.
#[derive(Clone, Debug)]
pub struct QueueOptions {
    /// Failures after which a job becomes a dead letter.
    pub max_attempts: u32,
    /// Crashes of the process or of a device during a job's run, counted since its last snapshot,
    /// after which it becomes a dead letter.
    pub max_crashes: u32,
    /// Time without a heartbeat after which a running job is requeued.
    pub lease: Duration,
    /// Delay before the second attempt; doubled for each later one.
    pub retry_delay: Duration,
    /// Maximum waiting time of a job without a deadline.
    pub time_to_live: Duration,
    /// Retention of an ended job and its result.
    pub retention: Duration,
    /// Retention of an ephemeral job, whose caller waited and has received the response.
    pub answered_retention: Duration,
}

impl Default for QueueOptions {
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
    /// The idempotency key was used with another payload, by this job.
    #[error("the idempotency key was used with another payload, by job {0}")]
    KeyReused(JobId),
    /// Only a job that has ended without success can be requeued.
    #[error("only a job that failed, expired or was cancelled is queued again: this one is {}", .0.name())]
    NotTerminal(State),
    /// The ephemeral job is being cancelled or was cancelled, and cannot become durable.
    #[error("the job is being cancelled")]
    GivenUp,
    /// The store failed: a fault of the machine, not of a job.
    #[error("the queue's store failed: {0}")]
    Store(String),
    /// The store cannot grow: the disk is full.
    #[error("the queue's store is full: {0}")]
    Full(String),
    /// The queue is closed.
    #[error("the queue is closed")]
    Closed,
}

impl QueueError {
    /// Whether the machine is at fault, so that a retry may succeed.
    pub fn is_of_the_machine(&self) -> bool {
        matches!(self, Self::Store(_) | Self::Full(_))
    }
}

/// An event of the queue, for the metrics and the cleanup of blobs.
#[derive(Clone, Debug)]
pub enum Event {
    /// A job was accepted.
    Submitted(Arc<Job>),
    /// A job was leased for the first time.
    Started(Arc<Job>),
    /// A job was requeued.
    Requeued(Arc<Job>),
    /// A lease expired.
    LeaseExpired(JobId),
    /// A job ended.
    Ended(Arc<Job>),
    /// A job was forgotten: its payload, snapshot and result can be removed.
    Deleted(JobId),
}

/// The job queue: submission, subscription, leases for workers, completion, cancellation and
/// requeueing. [`super::SqliteQueue`] implements it.
///
/// When a call returns `Ok` the change has taken effect, and is on disk if the job is durable. A job
/// may run more than once: an expired lease requeues it, and only the latest attempt can finish it.
#[async_trait]
pub trait Queue: Send + Sync {
    /// Accepts a job and, for a sequence, all of its pairs. A known idempotency key returns its
    /// job, unless that job is ephemeral and was cancelled, expired or failed: then the key is free
    /// again. A job that follows another one is queued, but not leased before that one has ended.
    async fn submit(&self, submission: Submission) -> Result<Submitted, QueueError>;

    /// Makes a job durable. Fails with [`QueueError::GivenUp`] if it is ephemeral and its
    /// cancellation was requested.
    async fn make_durable(&self, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// A job of one tenant; the jobs of other tenants are not found.
    async fn job(&self, tenant: &Tenant, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// The pairs of a sequence, in the order of submission.
    async fn pairs(&self, id: JobId) -> Result<Vec<Arc<Job>>, QueueError>;

    /// Lists jobs, latest first. The pairs of sequences are not listed.
    async fn list(&self, filter: Filter) -> Result<Vec<Arc<Job>>, QueueError>;

    /// Cancels a job: at once if it is queued, within an iteration if it is running.
    async fn cancel(&self, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// Cancels an ephemeral job whose caller has disconnected. A durable job is not changed.
    async fn abandon(&self, id: JobId) -> Result<(), QueueError>;

    /// Requeues an ended job with all counters but the attempt number reset, and makes it durable.
    /// A job that has succeeded is requeued only if its result is `lost`.
    async fn requeue(&self, id: JobId, lost: bool) -> Result<Arc<Job>, QueueError>;

    /// Subscribes to a job: its state and, while it runs, every iteration.
    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError>;

    /// Waits for the next job that a device of this kind may run, and leases it. Jobs that require
    /// the other kind are skipped.
    async fn lease(&self, worker: &str, kind: DeviceKind) -> Result<Lease, QueueError>;

    /// Ends an attempt. Only the latest attempt of a running job counts.
    async fn finish(
        &self,
        id: JobId,
        attempt: u32,
        outcome: Outcome,
    ) -> Result<Committed, QueueError>;

    /// The queued and running load.
    fn backlog(&self) -> Backlog;

    /// The earliest time since which a queued job has been ready to be leased.
    async fn oldest_queued(&self) -> Result<Option<Timestamp>, QueueError>;

    /// Tests the store: inserts and deletes a job, and waits for the disk.
    async fn probe(&self) -> Result<(), QueueError>;

    /// Whether there are no jobs.
    async fn is_empty(&self) -> Result<bool, QueueError>;

    /// Records a graceful shutdown: jobs that could not be released do not count as crashed.
    fn stopped(&self);

    /// The number that identifies this queue. A payload store with another number belongs to
    /// another queue.
    fn identity(&self) -> i32;

    /// Returns when the writer has ended. Only a new process can write again.
    async fn ended(&self);

    /// The ids in this list that belong to jobs.
    async fn known(&self, ids: Vec<JobId>) -> Result<Vec<JobId>, QueueError>;
}
