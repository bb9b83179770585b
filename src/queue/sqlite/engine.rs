//! The engine on one SQLite file.

use std::fmt;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;
use rusqlite::Connection;
use tokio::sync::{Semaphore, mpsc, watch};

use super::files::{Files, RUNNING, STOPPED, run_mark};
use super::heartbeat::SqliteHeartbeat;
use super::schema;
use super::statements::{NODE, SqliteSql};
use super::writer::Writer;
use crate::clock::Timestamp;
use crate::job::{Job, JobId};
use crate::queue::database::{DatabaseQueue, Engine, Kept};
use crate::queue::effects::Effects;
use crate::queue::interface::Queue;
use crate::queue::lease::HeartbeatStore;
use crate::queue::local::Local;
use crate::queue::migration::Migration;
use crate::queue::node::{Capacities, Node};
use crate::queue::sql::Sql;
use crate::queue::transitions;
use crate::queue::transitions::{clock, expiry, lists};
use crate::queue::types::{Event, QueueError, QueueOptions};
use crate::sync::locked;

/// Connections for reading.
const READERS: usize = 2;

/// Opens or creates the embedded queue in `folder`: one SQLite file, which one process at a time
/// has open. `events` receives all events from now on, including those of the recovery. The async
/// methods of the queue need a tokio runtime.
///
/// Changes of durable jobs, other than leases, are on disk before they are acknowledged.
///
/// Recovery requeues the durable jobs that were running when the queue was last open, and ends
/// those whose cancellation was requested. It counts a crash for each of the others, unless
/// [`Queue::stopped`] was called. At crash number [`QueueOptions::max_crashes`] a job becomes a
/// dead letter instead. Ephemeral jobs that were queued or running are removed.
///
/// # Errors
/// - [`QueueError::Store`] if another process has the queue open, a file or the folder cannot be
///   used, the file has another schema version, or the writer thread cannot be started.
/// - [`QueueError::Full`] if the database cannot grow because the disk is full.
pub fn open_sqlite(
    folder: &Path,
    options: QueueOptions,
    events: mpsc::UnboundedSender<Event>,
) -> Result<Arc<dyn Queue>, QueueError> {
    let engine = SqliteEngine::open(folder, &options, events)?;
    Ok(Arc::new(DatabaseQueue::new(engine, options)))
}

/// One SQLite file. One thread writes, and reads run concurrently.
pub(super) struct SqliteEngine {
    writer: Writer,
    readers: Arc<[Mutex<Connection>; READERS]>,
    /// A permit for each reader, so that no thread waits for one.
    turns: Arc<Semaphore>,
    local: Arc<Local>,
    options: QueueOptions,
    identity: i32,
    folder: PathBuf,
    files: Files,
    opened: Timestamp,
    _lock: File,
}

impl SqliteEngine {
    pub(super) fn open(
        folder: &Path,
        options: &QueueOptions,
        events: mpsc::UnboundedSender<Event>,
    ) -> Result<Self, QueueError> {
        let store = |error: std::io::Error| {
            QueueError::Store(format!("cannot use {}: {error}", folder.display()))
        };
        std::fs::create_dir_all(folder).map_err(store)?;
        let (lock, lock_path) = lock(folder)?;
        let path = folder.join("queue.sqlite3");
        let connection = schema::open_writer(&path)?;
        let identity = connection.pragma_query_value(None, "application_id", |row| row.get(0))?;
        let local = Arc::new(Local::new(events));
        recover(&connection, options, &local, || {
            run_mark(folder, STOPPED, RUNNING)
        })?;
        let open_reader = || schema::open_reader(&path).map(Mutex::new);
        Ok(Self {
            readers: Arc::new([open_reader()?, open_reader()?]),
            turns: Arc::new(Semaphore::new(READERS)),
            writer: Writer::start(connection, options.clone(), Arc::clone(&local))?,
            local,
            options: options.clone(),
            identity,
            folder: folder.to_owned(),
            files: Files::of([path, lock_path]).map_err(store)?,
            opened: Timestamp::now(),
            _lock: lock,
        })
    }
}

/// Locks the queue in a folder for this process. Returns the lock's file and its path.
fn lock(folder: &Path) -> Result<(File, PathBuf), QueueError> {
    let store = |error: std::io::Error| {
        QueueError::Store(format!("cannot use {}: {error}", folder.display()))
    };
    let path = folder.join("queue.lock");
    let mut options = File::options();
    let options = options.write(true).create(true).truncate(false);
    let lock = options.open(&path).map_err(store)?;
    match lock.try_lock() {
        Ok(()) => Ok((lock, path)),
        Err(TryLockError::WouldBlock) => Err(QueueError::Store(format!(
            "another process has the queue in {} open",
            folder.display()
        ))),
        Err(TryLockError::Error(error)) => Err(store(error)),
    }
}

/// Upgrades the file of the queue in `folder` to the schema version of this program.
///
/// # Errors
/// As [`open_sqlite`].
pub fn migrate_sqlite(folder: &Path) -> Result<Migration, QueueError> {
    let _lock = lock(folder)?;
    let path = folder.join("queue.sqlite3");
    let from = schema::version(&Connection::open(&path)?)?;
    schema::open_writer(&path)?;
    Ok(Migration {
        from,
        to: schema::VERSION,
    })
}

/// Takes over what the last process left behind. `orderly` tells whether it had stopped in order.
pub(super) fn recover(
    connection: &Connection,
    options: &QueueOptions,
    local: &Local,
    orderly: impl FnOnce() -> bool,
) -> Result<(), QueueError> {
    let sql = SqliteSql(connection);
    let mut effects = Effects::default();
    connection.execute_batch("BEGIN IMMEDIATE")?;
    let orderly = orderly();
    clock::bound(&sql, options)?;
    for id in expiry::left_behind(&sql, NODE)? {
        expiry::recover(&sql, &mut effects, options, id, NODE, orderly)?;
    }
    connection.execute_batch("COMMIT")?;
    local.apply(effects);
    // Now counted in the database itself.
    *locked(&local.backlog) = lists::count_backlog(&sql)?;
    Ok(())
}

/// Subscribes to a job: through the writer, so that no change falls between the query and the
/// subscription.
pub(super) async fn watch(
    writer: &Writer,
    local: &Arc<Local>,
    id: JobId,
) -> Result<watch::Receiver<Arc<Job>>, QueueError> {
    let local = Arc::clone(local);
    let change = move |sql: &dyn Sql, _: &mut Effects| {
        let job = Arc::new(transitions::get(sql, id)?);
        Ok(local.watchers.follow(&job))
    };
    writer.write(false, change).await
}

#[async_trait]
impl Engine for SqliteEngine {
    const NAME: &'static str = "sqlite";

    fn local(&self) -> &Arc<Local> {
        &self.local
    }

    async fn write<T, C>(&self, kept: Kept, change: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql, &mut Effects) -> Result<T, QueueError> + Send + 'static,
    {
        self.writer.write(kept == Kept::Durably, change).await
    }

    async fn read<T, C>(&self, query: C) -> Result<T, QueueError>
    where
        T: Send + 'static,
        C: Fn(&dyn Sql) -> Result<T, QueueError> + Send + 'static,
    {
        let store = |error: &dyn fmt::Display| QueueError::Store(error.to_string());
        let turn = Arc::clone(&self.turns).acquire_owned().await;
        let turn = turn.map_err(|error| store(&error))?;
        let readers = Arc::clone(&self.readers);
        let read = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            let free = readers.iter().find_map(|reader| reader.try_lock().ok());
            let reader = free.unwrap_or_else(|| locked(&readers[0]));
            query(&SqliteSql(&reader))
        });
        read.await.map_err(|error| store(&error))?
    }

    async fn watch(&self, id: JobId) -> Result<watch::Receiver<Arc<Job>>, QueueError> {
        watch(&self.writer, &self.local, id).await
    }

    fn heartbeat(&self, job: &Job) -> Arc<dyn HeartbeatStore> {
        Arc::new(SqliteHeartbeat::new(
            job,
            &self.writer,
            &self.local,
            &self.options,
        ))
    }

    fn poll_interval(&self) -> Option<Duration> {
        None
    }

    fn check(&self) -> Result<(), QueueError> {
        if self.files.are_there() {
            return Ok(());
        }
        let gone = "its files were removed or replaced while it was open".to_owned();
        Err(QueueError::Store(gone))
    }

    async fn nodes(&self, capacities: Capacities) -> Result<Vec<Node>, QueueError> {
        Ok(vec![Node {
            number: NODE,
            name: self.folder.display().to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            started: self.opened,
            is_this: true,
            capacities,
        }])
    }

    async fn stopped(&self) {
        if !run_mark(&self.folder, RUNNING, STOPPED) {
            tracing::warn!("the next start will take this end for a crash");
        }
    }

    fn identity(&self) -> i32 {
        self.identity
    }
}
