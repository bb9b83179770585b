//! The queue over a database: the same for every [`Engine`], which runs its transactions.

use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::watch;

use super::backlog::Backlog;
use super::effects::Effects;
use super::interface::Queue;
use super::lease::{HeartbeatStore, Lease, LeaseHeartbeat};
use super::local::{Local, Look};
use super::node::{Capacities, Node};
use super::outgoing::{Outgoing, Settled};
use super::sql::Sql;
use super::standing::Standing;
use super::transitions;
use super::transitions::{expiry, leases, lists, outbox, standing};
use super::types::{Committed, Filter, Outcome, QueueError, QueueOptions, Submission, Submitted};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobId, Tenant};
use crate::sync::locked;

/// When a change is on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kept {
    /// Before the change is acknowledged.
    Durably,
    /// SQLite: some time after the acknowledgement. PostgreSQL: before it, because its crash does
    /// not end the workers.
    Soon,
}

impl Kept {
    /// For a change of a job.
    fn of_job(is_durable: bool) -> Self {
        if is_durable {
            Self::Durably
        } else {
            Self::Soon
        }
    }
}

/// A database that runs the state transitions.
#[async_trait]
pub(super) trait Engine: Send + Sync + 'static {
    /// As [`Queue::engine`].
    const NAME: &'static str;

    /// What this process knows of the queue.
    fn local(&self) -> &Arc<Local>;

    /// Makes a change in a transaction, applies its effects, and returns its result. The change may
    /// be made again after a conflict or a fault; only one of its runs is committed.
    ///
    /// # Errors
    /// That of the change, or one of the store.
    async fn write<T, C>(&self, kept: Kept, change: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql, &mut Effects) -> Result<T, QueueError> + Send + 'static;

    /// Runs queries that change nothing.
    ///
    /// # Errors
    /// That of the query, or one of the store.
    async fn read<T, C>(&self, query: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql) -> Result<T, QueueError> + Send + 'static;

    /// As [`Queue::watch`].
    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError>;

    /// The sink of the heartbeats of a job that was just claimed.
    fn heartbeat(&self, job: &Job) -> Arc<dyn HeartbeatStore>;

    /// Whether a snapshot of this attempt was stored and its note is not written yet.
    fn has_note_of_snapshot(&self, _id: JobId, _attempt: u32) -> bool {
        false
    }

    /// Maximum time between two looks for a ready job. `None` if no other process has the queue
    /// open.
    fn poll_interval(&self) -> Option<Duration>;

    /// Whether the database is the one that was opened.
    ///
    /// # Errors
    /// [`QueueError::Store`] if it is not.
    fn check(&self) -> Result<(), QueueError>;

    /// As [`Queue::nodes`].
    async fn nodes(&self, own: Capacities) -> Result<Vec<Node>, QueueError>;

    /// As [`Queue::stopped`].
    async fn stopped(&self);

    /// As [`Queue::identity`].
    fn identity(&self) -> i32;
}

/// The queue over one engine.
pub(super) struct DatabaseQueue<E> {
    engine: E,
    options: Arc<QueueOptions>,
}

impl<E: Engine> DatabaseQueue<E> {
    pub(super) fn new(engine: E, options: QueueOptions) -> Self {
        Self {
            engine,
            options: Arc::new(options),
        }
    }

    /// Makes a change that needs the queue's options.
    async fn change<T: Send + 'static>(
        &self,
        kept: Kept,
        change: impl Fn(&dyn Sql, &mut Effects, &QueueOptions) -> Result<T, QueueError> + Send + 'static,
    ) -> Result<T, QueueError> {
        let options = Arc::clone(&self.options);
        let change = move |sql: &dyn Sql, effects: &mut Effects| change(sql, effects, &options);
        self.engine.write(kept, change).await
    }
}

#[async_trait]
impl<E: Engine> Queue for DatabaseQueue<E> {
    async fn submit(&self, submission: Submission) -> Result<Submitted, QueueError> {
        self.change(
            Kept::of_job(submission.durable),
            move |sql, effects, options| transitions::submit(sql, effects, options, &submission),
        )
        .await
    }

    async fn make_durable(&self, id: JobId) -> Result<Arc<Job>, QueueError> {
        if let Some(held) = locked(&self.engine.local().running).get(&id) {
            held.flags.make_durable();
        }
        self.change(Kept::Durably, move |sql, effects, options| {
            transitions::make_durable(sql, effects, options, id)
        })
        .await
    }

    async fn job(&self, tenant: &Tenant, id: JobId) -> Result<Arc<Job>, QueueError> {
        let job = self.engine.read(move |sql| transitions::get(sql, id));
        match job.await? {
            job if job.tenant == *tenant => Ok(Arc::new(job)),
            _ => Err(QueueError::NotFound),
        }
    }

    async fn pairs(&self, id: JobId) -> Result<Vec<Arc<Job>>, QueueError> {
        let pairs = self.engine.read(move |sql| transitions::pairs(sql, id));
        Ok(pairs.await?.into_iter().map(Arc::new).collect())
    }

    async fn list(&self, filter: Filter) -> Result<Vec<Arc<Job>>, QueueError> {
        self.engine.read(move |sql| lists::list(sql, &filter)).await
    }

    async fn standing(&self, id: JobId) -> Result<Option<Standing>, QueueError> {
        let found = self.engine.read(move |sql| standing::standing(sql, id));
        found.await
    }

    async fn cancel(&self, id: JobId) -> Result<Arc<Job>, QueueError> {
        self.change(Kept::Durably, move |sql, effects, options| {
            transitions::cancel(sql, effects, options, id)
        })
        .await
    }

    async fn abandon(&self, id: JobId) -> Result<(), QueueError> {
        self.change(Kept::Soon, move |sql, effects, options| {
            transitions::abandon(sql, effects, options, id)
        })
        .await
    }

    async fn requeue(&self, id: JobId, lost: bool) -> Result<Arc<Job>, QueueError> {
        self.change(Kept::Durably, move |sql, effects, options| {
            transitions::requeue(sql, effects, options, id, lost)
        })
        .await
    }

    async fn remove(&self, id: JobId) -> Result<(), QueueError> {
        self.change(Kept::Durably, move |sql, effects, options| {
            expiry::remove(sql, effects, options, id)
        })
        .await
    }

    async fn keep(&self, id: JobId) -> Result<Duration, QueueError> {
        self.change(Kept::Soon, move |sql, _, options| {
            expiry::keep(sql, options, id)?;
            Ok(options.answered_retention)
        })
        .await
    }

    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError> {
        self.engine.watch(id).await
    }

    async fn lease_until(
        &self,
        worker: &str,
        kind: DeviceKind,
        mut until: Pin<&mut (dyn Future<Output = ()> + Send)>,
    ) -> Result<Option<Lease>, QueueError> {
        let worker: Arc<str> = Arc::from(worker);
        loop {
            let local = self.engine.local();
            let mut woken = std::pin::pin!(local.woken());
            woken.as_mut().enable();
            let name = Arc::clone(&worker);
            let claim = self.change(Kept::Soon, move |sql, effects, options| {
                leases::claim(sql, effects, options, &name, kind)
            });
            match local.look(kind, until.as_mut(), claim).await? {
                Look::Found(job) => {
                    let flags = local.flags_of(&job);
                    let store = self.engine.heartbeat(&job);
                    let heartbeat = LeaseHeartbeat::new(flags, store);
                    return Ok(Some(Lease { job, heartbeat }));
                }
                Look::GivenUp => return Ok(None),
                Look::Empty => {}
            }
            let change = async {
                match self.engine.poll_interval() {
                    None => woken.await,
                    Some(interval) => {
                        if tokio::time::timeout(interval, woken).await.is_err() {
                            local.look_again(interval);
                        }
                    }
                }
            };
            tokio::select! {
                biased;
                () = until.as_mut() => return Ok(None),
                () = change => {}
            }
        }
    }

    async fn finish(
        &self,
        id: JobId,
        attempt: u32,
        outcome: Outcome,
    ) -> Result<Committed, QueueError> {
        let is_durable = locked(&self.engine.local().running)
            .get(&id)
            .is_some_and(|held| held.flags.is_durable());
        let has_snapshot = self.engine.has_note_of_snapshot(id, attempt);
        self.change(Kept::of_job(is_durable), move |sql, effects, options| {
            if has_snapshot {
                leases::snapshot_kept(sql, id, attempt)?;
            }
            leases::finish(sql, effects, options, id, attempt, outcome.clone())
        })
        .await
    }

    async fn take_outgoing(&self, limit: u32, hold: Duration) -> Result<Vec<Outgoing>, QueueError> {
        // A write would cost every idle node a commit.
        if !self.engine.read(outbox::has_due).await? {
            return Ok(Vec::new());
        }
        self.change(Kept::Soon, move |sql, _, _| outbox::take(sql, limit, hold))
            .await
    }

    async fn settle(&self, actions: Vec<(i64, Settled)>) -> Result<(), QueueError> {
        self.change(Kept::Soon, move |sql, _, _| outbox::settle(sql, &actions))
            .await
    }

    fn backlog(&self) -> Backlog {
        locked(&self.engine.local().backlog).clone()
    }

    async fn oldest_queued(&self) -> Result<Option<Timestamp>, QueueError> {
        self.engine.read(expiry::oldest_queued).await
    }

    async fn probe(&self) -> Result<(), QueueError> {
        self.engine.check()?;
        self.change(Kept::Durably, |sql, _, options| {
            transitions::probe(sql, options)
        })
        .await?;
        self.oldest_queued().await.map(drop)
    }

    async fn is_empty(&self) -> Result<bool, QueueError> {
        self.engine.read(lists::is_empty).await
    }

    async fn nodes(&self, own: Capacities) -> Result<Vec<Node>, QueueError> {
        self.engine.nodes(own).await
    }

    async fn stopped(&self) {
        self.engine.stopped().await;
    }

    fn identity(&self) -> i32 {
        self.engine.identity()
    }

    fn engine(&self) -> &'static str {
        E::NAME
    }

    async fn ended(&self) {
        self.engine.local().ended.cancelled().await;
    }

    async fn known(&self, ids: Vec<JobId>) -> Result<Vec<JobId>, QueueError> {
        self.engine.read(move |sql| lists::known(sql, &ids)).await
    }
}

/// A random number that identifies a new queue. The payload store records it, to detect a mismatch
/// of the two.
pub(super) fn new_identity() -> i32 {
    let bytes = *JobId::fresh().as_bytes();
    // The last bytes of a job id are random. Zero means that a file has no identity.
    i32::from_le_bytes([bytes[12], bytes[13], bytes[14], bytes[15] | 1])
}
