//! The tables, their indexes, and the check of the schema version.

use super::locks::SCHEMA;
use super::session::{Call, Flush, Session};
use crate::queue::database::new_identity;
use crate::queue::effects::Effects;
use crate::queue::migration::Migration;
use crate::queue::sql::{Sql, values};
use crate::queue::types::QueueError;

/// The schema version that this program reads and writes.
const VERSION: i64 = 5;

/// The oldest schema version that is upgraded.
const OLDEST: i64 = 2;

/// The changes from each version to the next, beginning with [`OLDEST`]. Nodes of the version before
/// may still run: they must get along with the tables.
const UPGRADES: [&[&str]; (VERSION - OLDEST) as usize] = [
    &[
        "ALTER TABLE jobs ADD COLUMN trace text, ADD COLUMN webhook text",
        OUTBOX,
        OUTBOX_DUE,
    ],
    &[
        "ALTER TABLE jobs ADD COLUMN result_uri text, ADD COLUMN delivery smallint",
        OUTBOX_JOB,
    ],
    &[OPEN_DUE],
];

const OUTBOX: &str = "CREATE TABLE outbox (
        seq bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
        job bytea NOT NULL,
        due bigint NOT NULL,
        attempts bigint NOT NULL,
        url text,
        body text
    ) WITH (autovacuum_vacuum_scale_factor = 0, autovacuum_vacuum_threshold = 1000)";

const OUTBOX_DUE: &str = "CREATE INDEX outbox_due ON outbox (due)";
const OUTBOX_JOB: &str = "CREATE INDEX outbox_job ON outbox (job)";
const OPEN_DUE: &str =
    "CREATE INDEX jobs_open_due ON jobs (due) WHERE due IS NOT NULL AND state < 2";

/// `jobs` has the columns of the embedded queue, with the same meanings. Rows change often, so
/// pages keep room for new versions of a row, and the table is vacuumed early.
///
/// `nodes` has a row for each process that takes part. `commits` has the last commit of each
/// connection of a node: it decides whether a transaction was committed whose answer was lost.
/// `labels` has one row for each label of a job, with the job's tenant as `owner`. `outbox` has one
/// row for each action outside the database that a commit has promised: a notice to `url`, without a
/// `body` the delivery of the job's result to it, and without a `url` the removal of the job's files.
/// `summary` has one row, the last count of the load.
const TABLES: [&str; 23] = [
    "CREATE TABLE meta (version bigint NOT NULL, identity bigint NOT NULL)",
    "CREATE TABLE nodes (
        id integer GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
        name text NOT NULL,
        version text NOT NULL,
        started bigint NOT NULL,
        stopped smallint NOT NULL DEFAULT 0,
        cpu_lanes integer NOT NULL DEFAULT 0,
        cpu_rate double precision NOT NULL DEFAULT 0,
        gpu_lanes integer NOT NULL DEFAULT 0,
        gpu_rate double precision NOT NULL DEFAULT 0
    )",
    "CREATE TABLE commits (
        node integer NOT NULL,
        place integer NOT NULL,
        count bigint NOT NULL,
        PRIMARY KEY (node, place)
    ) WITH (fillfactor = 50, autovacuum_vacuum_scale_factor = 0,
            autovacuum_vacuum_threshold = 1000)",
    "CREATE TABLE summary (taken bigint NOT NULL, snapshot text NOT NULL, load text NOT NULL)",
    "CREATE TABLE jobs (
        seq bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
        id bytea NOT NULL,
        tenant text COLLATE \"C\" NOT NULL,
        kind smallint NOT NULL,
        parent bytea,
        pair_index bigint NOT NULL,
        backward smallint NOT NULL,
        sees_from bigint NOT NULL,
        sees_to bigint NOT NULL,
        after bytea,
        has_dependents smallint NOT NULL,
        ready bigint,
        pairs integer NOT NULL,
        pairs_left integer NOT NULL,
        priority smallint NOT NULL,
        device smallint NOT NULL,
        state smallint NOT NULL,
        durable smallint NOT NULL,
        delayed smallint NOT NULL,
        attempt bigint NOT NULL,
        failures integer NOT NULL,
        crashes integer NOT NULL,
        delays integer NOT NULL,
        cost double precision NOT NULL,
        closes smallint NOT NULL,
        virtual_start double precision NOT NULL,
        virtual_finish double precision NOT NULL,
        options text NOT NULL,
        idempotency_key text COLLATE \"C\",
        fingerprint bytea,
        created bigint NOT NULL,
        started bigint,
        finished bigint,
        deadline bigint,
        expires bigint NOT NULL,
        due bigint,
        worker text,
        origin integer NOT NULL,
        holder integer,
        progress_done bigint,
        progress_total bigint,
        loss double precision,
        stop_reason text,
        error_code text,
        error_message text,
        error_retryable smallint NOT NULL,
        dead smallint NOT NULL,
        cancel_requested smallint NOT NULL,
        report text,
        trace text,
        webhook text,
        result_uri text,
        delivery smallint
    ) WITH (fillfactor = 70, autovacuum_vacuum_scale_factor = 0.02,
            autovacuum_vacuum_cost_delay = 0, autovacuum_analyze_scale_factor = 0.05)",
    "CREATE UNIQUE INDEX jobs_id ON jobs (id)",
    "CREATE UNIQUE INDEX jobs_key ON jobs (tenant, idempotency_key)
        WHERE idempotency_key IS NOT NULL",
    "CREATE INDEX jobs_ready ON jobs (device, priority DESC, virtual_start, seq)
        WHERE state = 0 AND ready IS NOT NULL AND delayed = 0",
    "CREATE INDEX jobs_running ON jobs (priority, virtual_start)
        WHERE state = 1 AND ready IS NOT NULL",
    "CREATE INDEX jobs_tail ON jobs (tenant, priority, virtual_finish)
        WHERE state < 2 AND (kind = 0 OR ready IS NOT NULL)",
    "CREATE INDEX jobs_due ON jobs (due) WHERE due IS NOT NULL",
    "CREATE INDEX jobs_after ON jobs (after) WHERE after IS NOT NULL AND state < 2",
    "CREATE INDEX jobs_ephemeral ON jobs (origin)
        WHERE durable = 0 AND parent IS NULL AND state < 2",
    "CREATE INDEX jobs_age ON jobs (ready) WHERE state = 0 AND ready IS NOT NULL",
    "CREATE INDEX jobs_list ON jobs (tenant, id) WHERE parent IS NULL",
    "CREATE INDEX jobs_list_by_state ON jobs (tenant, state, id) WHERE parent IS NULL",
    "CREATE INDEX jobs_parent ON jobs (parent) WHERE parent IS NOT NULL",
    "CREATE TABLE labels (
        owner text COLLATE \"C\" NOT NULL,
        label text COLLATE \"C\" NOT NULL,
        job bytea NOT NULL,
        PRIMARY KEY (owner, label, job)
    )",
    "CREATE INDEX labels_job ON labels (job)",
    OUTBOX,
    OUTBOX_DUE,
    OUTBOX_JOB,
    OPEN_DUE,
];

/// A database with the tables of this program's version.
#[derive(Clone, Copy, Debug)]
pub(super) struct Prepared {
    /// The number that identifies the queue.
    pub(super) identity: i32,
    /// The versions before and now.
    pub(super) migration: Migration,
}

/// Creates the tables in an empty database, or upgrades those of an older version.
pub(super) fn prepare(session: &mut Session) -> Result<Prepared, QueueError> {
    let identity = new_identity();
    let commit = session.transact(Flush::Always, Call::own(), |sql, _: &mut Effects| {
        create(sql, identity)
    })?;
    Ok(commit.value)
}

fn create(sql: &dyn Sql, identity: i32) -> Result<Prepared, QueueError> {
    // Nodes that start at the same time create the tables once.
    let lock = format!("SELECT pg_advisory_xact_lock({SCHEMA}, 0)::text");
    sql.query(&lock, &[])?;
    let there = "SELECT to_regclass('meta') IS NOT NULL, to_regclass('jobs') IS NOT NULL";
    let row = sql.only(there, &[])?;
    let is_there: bool = row.get(0)?;
    match (is_there, row.get(1)?) {
        (true, _) => {}
        (false, true) => {
            let other = "its database has a table jobs that is not of fnsf: give the queue a \
                         database of its own";
            return Err(QueueError::Store(other.to_owned()));
        }
        (false, false) => {
            for table in TABLES {
                sql.query(table, &[])?;
            }
            sql.query(
                "INSERT INTO meta (version, identity) VALUES (?1, ?2)",
                values![VERSION, identity],
            )?;
            sql.query(
                "INSERT INTO summary (taken, snapshot, load) VALUES (0, '', '')",
                &[],
            )?;
        }
    }
    let row = sql.only("SELECT version, identity FROM meta", &[])?;
    let version: i64 = row.get(0)?;
    if (OLDEST..VERSION).contains(&version) {
        for change in UPGRADES[(version - OLDEST) as usize..]
            .iter()
            .copied()
            .flatten()
        {
            sql.query(change, &[])?;
        }
        sql.query("UPDATE meta SET version = ?1", values![VERSION])?;
        tracing::info!(
            from = version,
            to = VERSION,
            "the queue's database is upgraded"
        );
    } else if version != VERSION {
        return Err(QueueError::Store(format!(
            "the queue's database has schema version {version}, this program knows {VERSION}: run \
             the program of that version"
        )));
    }
    let open = "SELECT has_database_privilege('public', current_database(), 'CONNECT')";
    if sql.only(open, &[])?.get(0)? {
        tracing::warn!(
            "every login of the database server may connect to the queue's database and hold its locks: \
             REVOKE CONNECT, TEMPORARY ON DATABASE its_name FROM PUBLIC"
        );
    }
    Ok(Prepared {
        identity: row.get(1)?,
        migration: Migration {
            from: if is_there { version } else { 0 },
            to: VERSION,
        },
    })
}
