//! The durable queue: jobs in, leases out, every promise kept.
//!
//! It moves jobs and never looks inside a payload or at options; it must not know doors, workers
//! or solvers. What it knows of a sequence is that some pairs wait for others, and that something
//! may be left to do when all are done. [`Queue`] is the contract and `contract.rs` its tests; [`SqliteQueue`] keeps it on
//! one machine.

mod backlog;
mod lease;
mod watchers;

mod sqlite;

#[cfg(test)]
mod contract;

use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::watch;

use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobError, JobId, JobProgress, Kind, Priority, State, Tenant};

pub use backlog::{Backlog, Load};
pub use lease::{Lease, Pulse, Signal};
pub use sqlite::SqliteQueue;

/// A job to be accepted.
#[derive(Clone, Debug)]
pub struct Submission {
    /// Its name, under which its payload already lies.
    pub id: JobId,
    /// Whose it is.
    pub tenant: Tenant,
    /// A pair or a sequence.
    pub kind: Kind,
    /// Which of its sweeps a pair is of; of no meaning for a sequence.
    pub pair: PairOf,
    /// The pairs of a sequence, in the order of their turns; none for a pair.
    pub pairs: Vec<PairOf>,
    /// Predicted compute seconds of what is left to do for a sequence when all of its pairs have
    /// succeeded; none where they are all of it.
    pub closing_seconds: Option<f64>,
    /// The job that has to end, however it does, before this one is started.
    pub after: Option<JobId>,
    /// Whether another job may come after this one, and use what it leaves behind.
    pub followed: bool,
    /// How urgent it is.
    pub priority: Priority,
    /// The kind of device that it has to be done on; none where any will do.
    pub device: Option<DeviceKind>,
    /// Predicted compute seconds, of each pair.
    pub cost_seconds: f64,
    /// The options, as JSON; opaque here.
    pub options: String,
    /// When the best flow so far is wanted; a job still queued then expires.
    pub deadline: Option<Timestamp>,
    /// Makes a repeated submission find the first one.
    pub idempotency: Option<Idempotency>,
    /// Whether it must outlive this process from now on. Without it, it ends with the process.
    pub durable: bool,
}

/// What a pair is of the sweeps that lie under its name, or its sequence's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PairOf {
    /// The earlier of its two sweeps.
    pub place: u32,
    /// Whether it goes back in time, from the later sweep to the earlier one.
    pub backward: bool,
    /// The sweeps that it is found from, its own among them: the first, and the one after the last.
    pub sees: [u32; 2],
    /// Whether it comes after the one before it in the list.
    pub follows: bool,
}

impl PairOf {
    /// Two sweeps, and nothing else.
    pub const ALONE: Self = Self {
        place: 0,
        backward: false,
        sees: [0, 2],
        follows: false,
    };

    /// Some of a sequence's sweeps, as [`PairOf::sees`] has them.
    pub fn seen(sweeps: Range<usize>) -> [u32; 2] {
        [sweeps.start, sweeps.end].map(|place| u32::try_from(place).unwrap_or(u32::MAX))
    }
}

/// What makes a repeated submission recognizable.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Idempotency {
    /// The caller's key, unique for the tenant.
    pub key: String,
    /// Of payload and options: the same key with another one is a mistake.
    pub fingerprint: [u8; 32],
}

/// What became of a submission.
#[derive(Clone, Debug)]
pub enum Submitted {
    /// It was accepted.
    New(Arc<Job>),
    /// It had been accepted before, under this name; nothing was added.
    Known(Arc<Job>),
}

/// Which jobs to list, latest first.
#[derive(Clone, Debug)]
pub struct Filter {
    /// Whose.
    pub tenant: Tenant,
    /// In which state; any where none is given.
    pub state: Option<State>,
    /// Only those older than this one.
    pub before: Option<JobId>,
    /// At most so many.
    pub limit: u32,
}

/// How an attempt ended.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// The result lies in store under this attempt.
    Succeeded {
        /// Why the optimization stopped, where there was one.
        stop_reason: Option<String>,
        /// What the solver reports, as JSON.
        report: String,
        /// How far it has come, where there was an iteration.
        progress: Option<Progress>,
    },
    /// It failed; a retryable failure is tried again while attempts are left.
    Failed(JobError),
    /// The worker stopped because the job's end was asked for.
    Cancelled,
    /// The worker had to let go through no fault of the job: it is queued again as it was.
    Released,
    /// The store works, and fails for this job all the same: it is queued again for later, behind the
    /// others, and given up after some of that.
    Delayed(JobError),
    /// It does not suit this device: it is queued again as it was, for one of that kind.
    Moved(DeviceKind),
    /// The device died under it, perhaps by another job's fault: it is queued again, and given up
    /// when that happens as often as the process may die.
    Crashed(JobError),
}

/// What became of an outcome.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Committed {
    /// It stands.
    Yes(State),
    /// Somebody else holds the job now, or it has ended: nothing was changed.
    Fenced,
}

/// How a queue treats jobs.
#[derive(Clone, Debug)]
pub struct QueueOptions {
    /// Failures after which a job is given up.
    pub max_attempts: u32,
    /// Deaths of the process or of a device in a job's run, without a new snapshot between them,
    /// after which it is given up.
    pub max_crashes: u32,
    /// Silence after which a running job is given to somebody else.
    pub lease: Duration,
    /// Wait before the second attempt; doubled for each one after it.
    pub retry_delay: Duration,
    /// Time that a job without a deadline may wait.
    pub time_to_live: Duration,
    /// Time that an ended job and its result are kept.
    pub retention: Duration,
    /// The same for a job whose caller waited for it and has its answer.
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

/// Why the queue could not do what was asked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum QueueError {
    /// No such job, or it is another tenant's.
    #[error("no job has this name")]
    NotFound,
    /// The idempotency key was used for something else; it belongs to this job.
    #[error("the idempotency key was used with another payload, by job {0}")]
    KeyReused(JobId),
    /// Only a job that has ended without success can be asked for again.
    #[error("only a job that failed, expired or was cancelled is queued again: this one is {}", .0.name())]
    NotOver(State),
    /// Its end was asked for before it was promised to anybody: it is as good as gone.
    #[error("the job is being cancelled")]
    GivenUp,
    /// The store failed: the machine's fault, never a job's.
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
    /// Whether the machine is at fault, so that the same may succeed later.
    pub fn is_of_the_machine(&self) -> bool {
        matches!(self, Self::Store(_) | Self::Full(_))
    }
}

/// Something that happened in the queue, for metrics and for whoever cleans up.
#[derive(Clone, Debug)]
pub enum Event {
    /// A job was accepted.
    Submitted(Arc<Job>),
    /// A job was leased for the first time.
    Started(Arc<Job>),
    /// A job went back into the queue.
    Requeued(Arc<Job>),
    /// A lease ran out.
    LeaseExpired(JobId),
    /// A job ended.
    Ended(Arc<Job>),
    /// A job was forgotten: its payload, snapshot and result may go.
    Forgotten(JobId),
}

/// The queue's contract. Whatever is answered has happened, and is on disk if the job is durable.
#[async_trait]
pub trait Queue: Send + Sync {
    /// Accepts a job, and for a sequence all of its pairs. A key that was used before finds that job,
    /// unless that one was never promised and was given up: then the key is free again. A job that comes after another one is
    /// queued, but nobody gets it before that one has ended.
    async fn submit(&self, submission: Submission) -> Result<Submitted, QueueError>;

    /// Makes a job outlive this process; refused as [`QueueError::GivenUp`] where its end was asked
    /// for before.
    async fn make_durable(&self, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// One tenant's job; other tenants' jobs are not found.
    async fn job(&self, tenant: &Tenant, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// The pairs of a sequence, in the order of their turns.
    async fn pairs(&self, id: JobId) -> Result<Vec<Arc<Job>>, QueueError>;

    /// Jobs, latest first; pairs of sequences are not listed by themselves.
    async fn list(&self, filter: Filter) -> Result<Vec<Arc<Job>>, QueueError>;

    /// Ends a job: at once if it is queued, within an iteration if it runs.
    async fn cancel(&self, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// Ends a job that somebody waited for and does not any more; one that was promised stays.
    async fn abandon(&self, id: JobId) -> Result<(), QueueError>;

    /// Queues an ended job again, as if it had never been tried; from now on it outlives the process.
    /// One that has succeeded only where its result is `lost`.
    async fn requeue(&self, id: JobId, lost: bool) -> Result<Arc<Job>, QueueError>;

    /// Follows a job: its state and, while it runs, every iteration.
    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError>;

    /// Waits for the next job that a device of this kind may do, and takes it. What only the
    /// other kind may do is passed by.
    async fn lease(&self, worker: &str, kind: DeviceKind) -> Result<Lease, QueueError>;

    /// Ends an attempt. Only the latest attempt of a running job counts.
    async fn finish(
        &self,
        id: JobId,
        attempt: u32,
        outcome: Outcome,
    ) -> Result<Committed, QueueError>;

    /// What waits and what runs.
    fn backlog(&self) -> Backlog;

    /// Since when the job that has waited longest for a device could have been started.
    async fn oldest_queued(&self) -> Result<Option<Timestamp>, QueueError>;

    /// Goes the way of a submission and back, and writes to the disk: whether the store can be used.
    async fn probe(&self) -> Result<(), QueueError>;

    /// Whether there is no job at all.
    async fn is_empty(&self) -> Result<bool, QueueError>;

    /// The process is about to end in order: what it could not give back has not died under it.
    fn stopped(&self);

    /// A number that says which queue this is; payloads of another one are not its own.
    fn identity(&self) -> i32;

    /// Returns when nothing can be written any more, whatever happens: a fresh process is needed.
    async fn ended(&self);

    /// Which of some names belong to jobs.
    async fn known(&self, ids: Vec<JobId>) -> Result<Vec<JobId>, QueueError>;
}

/// Progress as a worker reports it.
pub type Progress = JobProgress;
