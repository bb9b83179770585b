//! The table, its indexes, and the check of the schema version.
//!
//! One row per job. Every statement that must stay fast at a million rows names its index, and a
//! test checks its query plan: the planner's own choice costs a thousand times more.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

use rusqlite::{Connection, TransactionBehavior};

use crate::queue::database::new_identity;
use crate::queue::types::QueueError;

/// The schema version that this program reads and writes; stored in `user_version`.
pub(super) const VERSION: i64 = 11;

/// The oldest schema version that is upgraded.
pub(super) const OLDEST: i64 = 8;

/// The changes from each version to the next, beginning with [`OLDEST`].
const UPGRADES: [&[&str]; (VERSION - OLDEST) as usize] = [
    &[
        "ALTER TABLE jobs ADD COLUMN trace TEXT",
        "ALTER TABLE jobs ADD COLUMN webhook TEXT",
        OUTBOX,
    ],
    &[
        "ALTER TABLE jobs ADD COLUMN result_uri TEXT",
        "ALTER TABLE jobs ADD COLUMN delivery INTEGER",
        OUTBOX_JOB,
    ],
    &[OPEN_DUE],
];

const OUTBOX: &str = "
CREATE TABLE outbox (
    seq INTEGER PRIMARY KEY AUTOINCREMENT,
    job BLOB NOT NULL,
    due INTEGER NOT NULL,
    attempts INTEGER NOT NULL,
    url TEXT,
    body TEXT
);
CREATE INDEX outbox_due ON outbox (due);
";

const OUTBOX_JOB: &str = "CREATE INDEX outbox_job ON outbox (job);";

const OPEN_DUE: &str =
    "CREATE INDEX jobs_open_due ON jobs (due) WHERE due IS NOT NULL AND state < 2;";

/// `due` is the next time at which the expiry handles a row: the expiry or the end of the retry
/// delay of a queued job, the end of a running job's lease, or the end of an ended job's retention.
/// `ready` is the time since which a job can be leased. It is null while the job follows one that
/// has not ended. For a sequence it is null until all of its pairs have succeeded and its closing
/// job is queued. `origin` is the node that accepted a job, and `holder` the node whose worker holds
/// it or held it last.
///
/// `labels` has one row for each label of a job, with the job's tenant as `owner`. `outbox` has one
/// row for each action outside the database that a commit has promised: a notice to `url`, without a
/// `body` the delivery of the job's result to it, and without a `url` the removal of the job's files.
const TABLE: &str = "
CREATE TABLE jobs (
    seq INTEGER PRIMARY KEY,
    id BLOB NOT NULL,
    tenant TEXT NOT NULL,
    kind INTEGER NOT NULL,
    parent BLOB,
    pair_index INTEGER NOT NULL,
    backward INTEGER NOT NULL,
    sees_from INTEGER NOT NULL,
    sees_to INTEGER NOT NULL,
    after BLOB,
    has_dependents INTEGER NOT NULL,
    ready INTEGER,
    pairs INTEGER NOT NULL,
    pairs_left INTEGER NOT NULL,
    priority INTEGER NOT NULL,
    device INTEGER NOT NULL,
    state INTEGER NOT NULL,
    durable INTEGER NOT NULL,
    delayed INTEGER NOT NULL,
    attempt INTEGER NOT NULL,
    failures INTEGER NOT NULL,
    crashes INTEGER NOT NULL,
    delays INTEGER NOT NULL,
    cost REAL NOT NULL,
    closes INTEGER NOT NULL,
    virtual_start REAL NOT NULL,
    virtual_finish REAL NOT NULL,
    options TEXT NOT NULL,
    idempotency_key TEXT,
    fingerprint BLOB,
    created INTEGER NOT NULL,
    started INTEGER,
    finished INTEGER,
    deadline INTEGER,
    expires INTEGER NOT NULL,
    due INTEGER,
    worker TEXT,
    origin INTEGER NOT NULL,
    holder INTEGER,
    progress_done INTEGER,
    progress_total INTEGER,
    loss REAL,
    stop_reason TEXT,
    error_code TEXT,
    error_message TEXT,
    error_retryable INTEGER NOT NULL,
    dead INTEGER NOT NULL,
    cancel_requested INTEGER NOT NULL,
    report TEXT,
    trace TEXT,
    webhook TEXT,
    result_uri TEXT,
    delivery INTEGER
);
CREATE UNIQUE INDEX jobs_id ON jobs (id);
CREATE UNIQUE INDEX jobs_key ON jobs (tenant, idempotency_key) WHERE idempotency_key IS NOT NULL;
CREATE INDEX jobs_ready ON jobs (device, priority DESC, virtual_start, seq)
    WHERE state = 0 AND ready IS NOT NULL AND delayed = 0;
CREATE INDEX jobs_running ON jobs (priority, virtual_start) WHERE state = 1 AND ready IS NOT NULL;
CREATE INDEX jobs_tail ON jobs (tenant, priority, virtual_finish)
    WHERE state < 2 AND (kind = 0 OR ready IS NOT NULL);
CREATE INDEX jobs_due ON jobs (due) WHERE due IS NOT NULL;
CREATE INDEX jobs_after ON jobs (after) WHERE after IS NOT NULL AND state < 2;
CREATE INDEX jobs_ephemeral ON jobs (origin) WHERE durable = 0 AND parent IS NULL AND state < 2;
CREATE INDEX jobs_age ON jobs (ready) WHERE state = 0 AND ready IS NOT NULL;
CREATE INDEX jobs_list ON jobs (tenant, id) WHERE parent IS NULL;
CREATE INDEX jobs_list_by_state ON jobs (tenant, state, id) WHERE parent IS NULL;
CREATE INDEX jobs_parent ON jobs (parent) WHERE parent IS NOT NULL;
CREATE TABLE labels (
    owner TEXT NOT NULL,
    label TEXT NOT NULL,
    job BLOB NOT NULL,
    PRIMARY KEY (owner, label, job)
) WITHOUT ROWID;
CREATE INDEX labels_job ON labels (job);
";

/// Opens the connection of the writer.
pub(super) fn open_writer(path: &std::path::Path) -> Result<Connection, QueueError> {
    let mut connection = open(path)?;
    // A file that was copied may have been readable for others; the log gets its mode.
    if let Err(error) = std::fs::set_permissions(path, Permissions::from_mode(0o600)) {
        tracing::warn!(%error, "the queue's file keeps its mode");
    }
    connection.pragma_update(None, "journal_mode", "WAL")?;
    migrate(&mut connection)?;
    Ok(connection)
}

/// Opens a read-only connection.
pub(super) fn open_reader(path: &std::path::Path) -> Result<Connection, QueueError> {
    let connection = open(path)?;
    connection.pragma_update(None, "query_only", true)?;
    Ok(connection)
}

fn open(path: &std::path::Path) -> Result<Connection, QueueError> {
    const STATEMENTS: usize = 64;
    let connection = Connection::open(path)?;
    connection.busy_timeout(Duration::from_secs(10))?;
    connection.pragma_update(None, "cache_size", -16_384)?;
    connection.set_prepared_statement_cache_capacity(STATEMENTS);
    Ok(connection)
}

/// Creates the tables and indexes.
pub(super) fn create(connection: &Connection) -> Result<(), QueueError> {
    connection.execute_batch(TABLE)?;
    connection.execute_batch(OUTBOX)?;
    connection.execute_batch(OUTBOX_JOB)?;
    connection.execute_batch(OPEN_DUE)?;
    Ok(())
}

/// The schema version of a file; 0 of an empty one.
pub(super) fn version(connection: &Connection) -> Result<i64, QueueError> {
    Ok(connection.pragma_query_value(None, "user_version", |row| row.get(0))?)
}

fn migrate(connection: &mut Connection) -> Result<(), QueueError> {
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    match version(&transaction)? {
        0 => {
            create(&transaction)?;
            transaction.pragma_update(None, "application_id", new_identity())?;
            transaction.pragma_update(None, "user_version", VERSION)?;
        }
        VERSION => {}
        older @ OLDEST..VERSION => {
            for change in UPGRADES[(older - OLDEST) as usize..]
                .iter()
                .copied()
                .flatten()
            {
                transaction.execute_batch(change)?;
            }
            transaction.pragma_update(None, "user_version", VERSION)?;
            tracing::info!(from = older, to = VERSION, "the queue's file is upgraded");
        }
        older if older < OLDEST => {
            return Err(QueueError::Store(format!(
                "the queue's file has version {older}, this program upgrades {OLDEST} and later: \
                 name another data_dir"
            )));
        }
        newer => {
            return Err(QueueError::Store(format!(
                "the queue's file has version {newer}, this program knows {VERSION}: \
                 run the newer program"
            )));
        }
    }
    transaction.commit()?;
    Ok(())
}
