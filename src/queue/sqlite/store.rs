//! Implementation of the queue on one SQLite file.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use async_trait::async_trait;
use rusqlite::{Connection, params};
use tokio::sync::{mpsc, watch};

use super::effects::Effects;
use super::files::{Files, RUNNING, STOPPED, run_mark};
use super::heartbeat::SqliteHeartbeat;
use super::rows::{COLUMNS, state_code};
use super::shared::Shared;
use super::writer::Writer;
use super::{expiry, finish, leases, rows, schema, submit};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobId, Tenant};
use crate::queue::backlog::{Backlog, BacklogKey, Load};
use crate::queue::lease::{Flags, Lease, LeaseHeartbeat};
use crate::queue::types::{
    Committed, Event, Filter, Outcome, Queue, QueueError, QueueOptions, Submission, Submitted,
};
use crate::sync::locked;

/// Connections for reading.
const READERS: usize = 2;

/// Maximum number of rows in one list.
const MAX_LISTED: u32 = 1000;

/// The queue in one SQLite file of one machine. One thread writes, and reads run concurrently.
///
/// Changes of durable jobs, other than leases, are on disk before they are acknowledged. A lock
/// file lets only one process at a time open the queue. The async methods need a tokio runtime.
pub struct SqliteQueue {
    writer: Writer,
    readers: [Arc<Mutex<Connection>>; READERS],
    next_reader: AtomicU64,
    pub(super) shared: Arc<Shared>,
    options: QueueOptions,
    identity: i32,
    folder: PathBuf,
    files: Files,
    _lock: File,
}

impl SqliteQueue {
    /// Opens or creates the queue in `folder`. `events` receives all events from now on, including
    /// those of the recovery.
    ///
    /// Recovery requeues the durable jobs that were running when the queue was last open, and ends
    /// those whose cancellation was requested. It counts a crash for each of the others, unless
    /// [`Queue::stopped`] was called. At crash number [`QueueOptions::max_crashes`] a job becomes a
    /// dead letter instead. Ephemeral jobs that were queued or running are removed.
    ///
    /// # Errors
    /// - [`QueueError::Store`] if another process has the queue open, a file or the folder cannot
    ///   be used, the file has another schema version, or the writer thread cannot be started.
    /// - [`QueueError::Full`] if the database cannot grow because the disk is full.
    pub fn open(
        folder: &Path,
        options: QueueOptions,
        events: mpsc::UnboundedSender<Event>,
    ) -> Result<Self, QueueError> {
        let store = |error: std::io::Error| {
            QueueError::Store(format!("cannot use {}: {error}", folder.display()))
        };
        std::fs::create_dir_all(folder).map_err(store)?;
        let lock_path = folder.join("queue.lock");
        let mut options_of_lock = File::options();
        let lock = options_of_lock.write(true).create(true).truncate(false);
        let lock = lock.open(&lock_path).map_err(store)?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(QueueError::Store(format!(
                    "another process has the queue in {} open",
                    folder.display()
                )));
            }
            Err(TryLockError::Error(error)) => return Err(store(error)),
        }
        let path = folder.join("queue.sqlite3");
        let connection = schema::open_writer(&path)?;
        let identity = connection.pragma_query_value(None, "application_id", |row| row.get(0))?;
        let shared = Arc::new(Shared::new(events));
        let mut effects = Effects::default();
        connection.execute_batch("BEGIN IMMEDIATE")?;
        let orderly = run_mark(folder, STOPPED, RUNNING);
        expiry::recover(&connection, &mut effects, &options, orderly)?;
        connection.execute_batch("COMMIT")?;
        // Counted below from the database itself.
        effects.entered.clear();
        effects.left.clear();
        effects.stopped.clear();
        shared.apply(effects);
        *locked(&shared.backlog) = count_backlog(&connection)?;
        let open_reader = || schema::open_reader(&path).map(|reader| Arc::new(Mutex::new(reader)));
        Ok(Self {
            readers: [open_reader()?, open_reader()?],
            next_reader: AtomicU64::new(0),
            writer: Writer::start(connection, options.clone(), Arc::clone(&shared))?,
            shared,
            options,
            identity,
            folder: folder.to_owned(),
            files: Files::of([path, lock_path]).map_err(store)?,
            _lock: lock,
        })
    }

    /// Runs a query on a reader connection, concurrently with the writer.
    async fn read<T: Send + 'static>(
        &self,
        query: impl FnOnce(&Connection) -> Result<T, QueueError> + Send + 'static,
    ) -> Result<T, QueueError> {
        let turn = self.next_reader.fetch_add(1, Ordering::Relaxed) as usize % READERS;
        let reader = Arc::clone(&self.readers[turn]);
        let read = tokio::task::spawn_blocking(move || query(&locked(&reader)));
        read.await
            .map_err(|error| QueueError::Store(error.to_string()))?
    }
}

/// Counts the queued load in the database.
fn count_backlog(connection: &Connection) -> Result<Backlog, QueueError> {
    let sql = "SELECT tenant, priority, device, count(*), sum(cost) FROM jobs \
               WHERE state = 0 AND (kind = 0 OR ready IS NOT NULL) \
               GROUP BY tenant, priority, device";
    let mut backlog = Backlog::default();
    let mut statement = connection.prepare(sql)?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        let key = BacklogKey {
            tenant: rows::tenant_at(row, 0)?,
            priority: rows::priority_at(row, 1)?,
            device: rows::device_at(row, 2)?,
        };
        let jobs: u32 = row.get(3)?;
        let load = Load {
            jobs: u64::from(jobs),
            seconds: row.get(4)?,
        };
        backlog.enter_many(key, load);
    }
    Ok(backlog)
}

#[async_trait]
impl Queue for SqliteQueue {
    async fn submit(&self, submission: Submission) -> Result<Submitted, QueueError> {
        let options = self.options.clone();
        self.writer
            .write(submission.durable, move |connection, effects| {
                submit::submit(connection, effects, &options, &submission)
            })
            .await
    }

    async fn make_durable(&self, id: JobId) -> Result<Arc<Job>, QueueError> {
        if let Some(held) = locked(&self.shared.running).get(&id) {
            held.flags.make_durable();
        }
        let retention = self.options.retention.as_millis() as i64;
        let change = move |connection: &Connection, effects: &mut Effects| {
            let job = rows::get(connection, id)?;
            if !job.durable && job.cancel_requested {
                return Err(QueueError::GivenUp);
            }
            let sql = "UPDATE jobs SET durable = 1, due = CASE WHEN state > 1 AND parent IS NULL \
                       THEN finished + ?2 ELSE due END WHERE id = ?1 OR parent = ?1";
            connection
                .prepare_cached(sql)?
                .execute(params![id.as_bytes(), retention])?;
            let job = Arc::new(rows::get(connection, id)?);
            effects.changed.push(Arc::clone(&job));
            Ok(job)
        };
        self.writer.write(true, change).await
    }

    async fn job(&self, tenant: &Tenant, id: JobId) -> Result<Arc<Job>, QueueError> {
        let job = self
            .read(move |connection| rows::get(connection, id))
            .await?;
        if job.tenant == *tenant {
            Ok(Arc::new(job))
        } else {
            Err(QueueError::NotFound)
        }
    }

    async fn pairs(&self, id: JobId) -> Result<Vec<Arc<Job>>, QueueError> {
        let pairs = self
            .read(move |connection| rows::pairs(connection, id))
            .await?;
        Ok(pairs.into_iter().map(Arc::new).collect())
    }

    async fn list(&self, filter: Filter) -> Result<Vec<Arc<Job>>, QueueError> {
        let query = move |connection: &Connection| {
            let before = filter.before.map_or([0xff; 16], |id| *id.as_bytes());
            let limit = filter.limit.min(MAX_LISTED);
            let (index, in_state) = match filter.state {
                None => ("jobs_list", ""),
                Some(_) => ("jobs_list_by_state", "AND state = ?4"),
            };
            let sql = format!(
                "SELECT {COLUMNS} FROM jobs INDEXED BY {index} WHERE parent IS NULL \
                 AND tenant = ?1 AND id < ?2 {in_state} ORDER BY id DESC LIMIT ?3"
            );
            let mut statement = connection.prepare_cached(&sql)?;
            let tenant = filter.tenant.as_str();
            let rows = match filter.state {
                None => statement.query_map(params![tenant, before, limit], rows::job)?,
                Some(state) => {
                    let state = state_code(state);
                    statement.query_map(params![tenant, before, limit, state], rows::job)?
                }
            };
            Ok(rows
                .map(|job| job.map(Arc::new))
                .collect::<rusqlite::Result<_>>()?)
        };
        self.read(query).await
    }

    async fn cancel(&self, id: JobId) -> Result<Arc<Job>, QueueError> {
        let options = self.options.clone();
        let change = move |connection: &Connection, effects: &mut Effects| {
            finish::cancel(connection, effects, &options, id)
        };
        self.writer.write(true, change).await
    }

    async fn abandon(&self, id: JobId) -> Result<(), QueueError> {
        let options = self.options.clone();
        let change =
            move |connection: &Connection, effects: &mut Effects| match rows::find(connection, id)?
            {
                Some(job) if !job.durable => {
                    finish::cancel(connection, effects, &options, id).map(drop)
                }
                _ => Ok(()),
            };
        self.writer.write(false, change).await
    }

    async fn requeue(&self, id: JobId, lost: bool) -> Result<Arc<Job>, QueueError> {
        let options = self.options.clone();
        let change = move |connection: &Connection, effects: &mut Effects| {
            finish::requeue(connection, effects, &options, id, lost)
        };
        self.writer.write(true, change).await
    }

    async fn remove(&self, id: JobId) -> Result<(), QueueError> {
        let options = self.options.clone();
        let change = move |connection: &Connection, effects: &mut Effects| {
            expiry::remove(connection, effects, &options, id)
        };
        self.writer.write(true, change).await
    }

    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError> {
        // Through the writer, so that no change falls between the query and the subscription.
        let shared = Arc::clone(&self.shared);
        let change = move |connection: &Connection, _: &mut Effects| {
            let job = Arc::new(rows::get(connection, id)?);
            Ok(shared.watchers.follow(&job))
        };
        self.writer.write(false, change).await
    }

    async fn lease(&self, worker: &str, kind: DeviceKind) -> Result<Lease, QueueError> {
        let worker: Arc<str> = Arc::from(worker);
        loop {
            let ready = self.shared.ready.notified();
            let mut ready = std::pin::pin!(ready);
            ready.as_mut().enable();
            let (options, name) = (self.options.clone(), Arc::clone(&worker));
            let claim = move |connection: &Connection, effects: &mut Effects| {
                leases::claim(connection, effects, &options, &name, kind)
            };
            if let Some(job) = self.writer.write(false, claim).await? {
                return Ok(self.hold(job));
            }
            ready.await;
        }
    }

    async fn finish(
        &self,
        id: JobId,
        attempt: u32,
        outcome: Outcome,
    ) -> Result<Committed, QueueError> {
        let durable = locked(&self.shared.running)
            .get(&id)
            .is_some_and(|held| held.flags.is_durable());
        let options = self.options.clone();
        let change = move |connection: &Connection, effects: &mut Effects| {
            leases::finish(connection, effects, &options, id, attempt, outcome)
        };
        self.writer.write(durable, change).await
    }

    fn backlog(&self) -> Backlog {
        locked(&self.shared.backlog).clone()
    }

    async fn oldest_queued(&self) -> Result<Option<Timestamp>, QueueError> {
        self.read(expiry::oldest_queued).await
    }

    async fn probe(&self) -> Result<(), QueueError> {
        if !self.files.are_there() {
            let gone = "its files were removed or replaced while it was open".to_owned();
            return Err(QueueError::Store(gone));
        }
        let options = self.options.clone();
        self.writer
            .write(true, move |connection, _| {
                submit::probe(connection, &options)
            })
            .await?;
        self.oldest_queued().await.map(drop)
    }

    async fn is_empty(&self) -> Result<bool, QueueError> {
        let sql = "SELECT NOT EXISTS (SELECT 1 FROM jobs)";
        let query =
            move |connection: &Connection| Ok(connection.query_row(sql, [], |row| row.get(0))?);
        self.read(query).await
    }

    fn stopped(&self) {
        if !run_mark(&self.folder, RUNNING, STOPPED) {
            tracing::warn!("the next start will take this end for a crash");
        }
    }

    fn identity(&self) -> i32 {
        self.identity
    }

    async fn ended(&self) {
        self.shared.ended.cancelled().await;
    }

    async fn known(&self, ids: Vec<JobId>) -> Result<Vec<JobId>, QueueError> {
        let query = move |connection: &Connection| {
            let mut known = Vec::new();
            for id in ids {
                if rows::find(connection, id)?.is_some() {
                    known.push(id);
                }
            }
            Ok(known)
        };
        self.read(query).await
    }
}

impl SqliteQueue {
    /// Builds the lease of a job that was just claimed.
    fn hold(&self, job: Arc<Job>) -> Lease {
        let flags = match locked(&self.shared.running).get(&job.id) {
            Some(held) if held.attempt == job.attempt => Arc::clone(&held.flags),
            // The lease was lost after the claim.
            _ => {
                let flags = Flags::default();
                flags.mark_lost();
                Arc::new(flags)
            }
        };
        let store = SqliteHeartbeat {
            id: job.id,
            attempt: job.attempt,
            writer: self.writer.clone(),
            shared: Arc::clone(&self.shared),
            options: self.options.clone(),
            last: Mutex::new(Instant::now()),
            latest: Mutex::default(),
        };
        Lease {
            job,
            heartbeat: LeaseHeartbeat::new(flags, Arc::new(store)),
        }
    }
}
