//! The interface of the queue: the `Queue` trait.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::watch;

use super::backlog::Backlog;
use super::lease::Lease;
use super::node::{Capacities, Node};
use super::outgoing::{Outgoing, Settled};
use super::standing::Standing;
use super::types::{Committed, Filter, Outcome, QueueError, Submission, Submitted};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobId, Tenant};

/// The job queue: submission, subscription, leases for workers, completion, cancellation and
/// requeueing. [`super::open_sqlite`] and [`super::open_postgres`] open one.
///
/// When a call returns `Ok` the change has taken effect. It is on disk if the job is durable,
/// except for a lease. A job may run more than once: an expired lease requeues it, and only the
/// latest attempt can finish it.
///
/// # Errors
/// "An error of the store" below is one of these. Further errors are listed with each method.
/// - [`QueueError::Store`] if the store cannot be read or written.
/// - [`QueueError::Full`] if the disk is full.
/// - [`QueueError::Closed`] if the writer has ended. Methods that only read, other than
///   [`Queue::watch`], still work then.
#[async_trait]
pub trait Queue: Send + Sync {
    /// Accepts a job and, for a sequence, all of its pairs. A known idempotency key returns its
    /// job, unless that job is ephemeral, and has ended without success or is being cancelled: then
    /// the key is free again. A job that follows another one is queued, but not leased before that
    /// one has ended.
    ///
    /// # Errors
    /// [`QueueError::KeyReused`] if the idempotency key belongs to a job with another fingerprint.
    /// [`QueueError::Store`] if the id belongs to another job. Otherwise an error of the store.
    async fn submit(&self, submission: Submission) -> Result<Submitted, QueueError>;

    /// Makes a job durable and, for a sequence, its pairs. Returns the job. If it has ended, its
    /// [`QueueOptions::retention`](super::QueueOptions::retention) begins.
    ///
    /// # Errors
    /// [`QueueError::NotFound`] if there is no such job. [`QueueError::GivenUp`] if it is ephemeral
    /// and its cancellation was requested. Otherwise an error of the store.
    async fn make_durable(&self, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// Reads the job with this id, if it belongs to this tenant.
    ///
    /// # Errors
    /// [`QueueError::NotFound`] if there is no such job or it belongs to another tenant, or an
    /// error of the store.
    async fn job(&self, tenant: &Tenant, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// The pairs of a sequence, in the order of submission. Empty for a pair or an unknown id.
    ///
    /// # Errors
    /// An error of the store.
    async fn pairs(&self, id: JobId) -> Result<Vec<Arc<Job>>, QueueError>;

    /// Lists jobs, latest first. The pairs of sequences are not listed.
    ///
    /// # Errors
    /// An error of the store.
    async fn list(&self, filter: Filter) -> Result<Vec<Arc<Job>>, QueueError>;

    /// The standing of a queued job. Of a sequence it is that of its first queued pair or of its closing
    /// job. `None` if nothing of the job is queued.
    ///
    /// # Errors
    /// An error of the store.
    async fn standing(&self, id: JobId) -> Result<Option<Standing>, QueueError>;

    /// Cancels a job and, for a sequence, its pairs. Returns the job as it is then. A queued job
    /// ends at once. The worker of a running job receives [`super::Signal::Cancel`], and the job
    /// ends when the worker finishes the attempt or its lease expires. An ended job is not changed.
    ///
    /// # Errors
    /// [`QueueError::NotFound`] if there is no such job, or an error of the store.
    async fn cancel(&self, id: JobId) -> Result<Arc<Job>, QueueError>;

    /// Cancels an ephemeral job whose caller has disconnected. A durable or unknown job is not
    /// changed.
    ///
    /// # Errors
    /// An error of the store.
    async fn abandon(&self, id: JobId) -> Result<(), QueueError>;

    /// Requeues an ended job, makes it durable and removes its deadline. All counters but the
    /// attempt number are reset. Of a sequence, the pairs that did not succeed, those that a deadline
    /// stopped early, and the closing job are requeued. A requeued pair reopens its sequence.
    ///
    /// A job that has succeeded is requeued only if `lost` is true. It says that the job's result
    /// is lost; for a sequence, the result of its closing job.
    ///
    /// # Errors
    /// [`QueueError::NotFound`] if there is no such job. [`QueueError::NotTerminal`] if it has not
    /// ended, or has succeeded and is not `lost`. Otherwise an error of the store.
    async fn requeue(&self, id: JobId, lost: bool) -> Result<Arc<Job>, QueueError>;

    /// Removes an ended job and, of a sequence, its pairs: payload, snapshot and result go with
    /// [`Action::RemoveFiles`](super::Action::RemoveFiles), and its idempotency key is free again. A job that another one follows is
    /// removed after the end of that one.
    ///
    /// # Errors
    /// [`QueueError::NotFound`] if there is no such job. [`QueueError::NotEnded`] if it has not
    /// ended. [`QueueError::PairOfSequence`] if it is a pair of a sequence. Otherwise an error of
    /// the store.
    async fn remove(&self, id: JobId) -> Result<(), QueueError>;

    /// Restarts the retention of an ended ephemeral job. Its result has not been read yet. Returns
    /// the retention, [`QueueOptions::answered_retention`]. Other jobs are not changed.
    ///
    /// [`QueueOptions::answered_retention`]: super::QueueOptions::answered_retention
    ///
    /// # Errors
    /// [`QueueError::NotFound`] if there is no such job, or an error of the store.
    async fn keep(&self, id: JobId) -> Result<Duration, QueueError>;

    /// Subscribes to a job: its state and, while it runs, its progress. The channel keeps only the
    /// latest value, so a slow receiver misses values in between. It closes when the job has ended.
    /// The last value can still be read then.
    ///
    /// # Errors
    /// [`QueueError::NotFound`] if there is no such job, or an error of the store.
    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError>;

    /// Waits for the next job that a device of this kind may run, and leases it to `worker`, a name
    /// that is stored with the job. Jobs that require the other kind are skipped.
    ///
    /// The wait ends with `None` when `until` is ready. It is polled before each claim, and a claim
    /// that has begun is completed. So no job is lost between the queue and a worker that leaves.
    ///
    /// If the future is dropped, the lease may already exist. The job is then queued again when the
    /// lease expires.
    ///
    /// # Errors
    /// An error of the store.
    async fn lease_until(
        &self,
        worker: &str,
        kind: DeviceKind,
        until: Pin<&mut (dyn Future<Output = ()> + Send)>,
    ) -> Result<Option<Lease>, QueueError>;

    /// [`Queue::lease_until`] by a worker that waits for as long as it takes.
    ///
    /// # Errors
    /// An error of the store.
    async fn lease(&self, worker: &str, kind: DeviceKind) -> Result<Lease, QueueError> {
        loop {
            let forever = std::pin::pin!(std::future::pending());
            if let Some(lease) = self.lease_until(worker, kind, forever).await? {
                return Ok(lease);
            }
        }
    }

    /// Ends an attempt. Only the latest attempt of a running job counts; for any other the result
    /// is [`Committed::Fenced`]. After a cancellation request, every outcome counts as
    /// [`Outcome::Cancelled`].
    ///
    /// # Errors
    /// An error of the store.
    async fn finish(
        &self,
        id: JobId,
        attempt: u32,
        outcome: Outcome,
    ) -> Result<Committed, QueueError>;

    /// Takes up to `limit` due actions of the outbox, the earliest first. No other node gets them for
    /// `hold`; an action that is not settled until then is due again.
    ///
    /// # Errors
    /// An error of the store.
    async fn take_outgoing(&self, limit: u32, hold: Duration) -> Result<Vec<Outgoing>, QueueError>;

    /// Ends actions of the outbox: removes those that are done, and makes the others due after their
    /// delay.
    ///
    /// # Errors
    /// An error of the store.
    async fn settle(&self, actions: Vec<(i64, Settled)>) -> Result<(), QueueError>;

    /// The load of the jobs that are queued and running now.
    fn backlog(&self) -> Backlog;

    /// The earliest time at which one of the queued jobs became ready to be leased. Jobs that wait
    /// for a retry count with their first such time; jobs that follow a job that has not ended do
    /// not count. `None` if there is no such job.
    ///
    /// # Errors
    /// An error of the store.
    async fn oldest_queued(&self) -> Result<Option<Timestamp>, QueueError>;

    /// Tests the store: inserts and deletes a job, waits for the disk, and reads.
    ///
    /// # Errors
    /// An error of the store. [`QueueError::Store`] also if its files were removed or replaced.
    async fn probe(&self) -> Result<(), QueueError>;

    /// Whether there are no jobs.
    ///
    /// # Errors
    /// An error of the store.
    async fn is_empty(&self) -> Result<bool, QueueError>;

    /// Tells the other nodes what this one can do, and returns all nodes, this one included.
    ///
    /// # Errors
    /// An error of the store.
    async fn nodes(&self, own: Capacities) -> Result<Vec<Node>, QueueError>;

    /// Records a graceful shutdown. The next start then counts no crash for the jobs that could not
    /// be released.
    async fn stopped(&self);

    /// The number that identifies this queue. A blob store with another number belongs to another
    /// queue.
    fn identity(&self) -> i32;

    /// The name of what keeps this queue: `sqlite` or `postgres`.
    fn engine(&self) -> &'static str;

    /// Returns when the writer has ended. Only a new process can write again.
    async fn ended(&self);

    /// The ids in this list that belong to jobs, pairs of sequences included, in the same order.
    ///
    /// # Errors
    /// An error of the store.
    async fn known(&self, ids: Vec<JobId>) -> Result<Vec<JobId>, QueueError>;
}
