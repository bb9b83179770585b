//! Conversion between database rows and jobs.

use rusqlite::{Connection, OptionalExtension, Row};

use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobError, JobId, JobProgress, Kind, Priority, State, Tenant};
use crate::queue::types::QueueError;

/// The columns that [`job`] reads, in its order.
pub(super) const COLUMNS: &str = "id, tenant, kind, parent, pair_index, pairs, pairs_left, priority, \
    state, durable, attempt, cost, options, created, started, finished, deadline, progress_done, \
    progress_total, loss, stop_reason, error_code, error_message, error_retryable, dead, \
    cancel_requested, report, device, backward, after, has_dependents, ready, sees_from, sees_to, \
    crashes";

pub(super) fn state_code(state: State) -> i64 {
    match state {
        State::Queued => 0,
        State::Running => 1,
        State::Succeeded => 2,
        State::Failed => 3,
        State::Cancelled => 4,
        State::Expired => 5,
    }
}

pub(super) fn priority_code(priority: Priority) -> i64 {
    match priority {
        Priority::Low => 0,
        Priority::Normal => 1,
        Priority::High => 2,
    }
}

/// The code of a job's device requirement: its index in [`DEVICES`].
pub(super) fn device_code(device: Option<DeviceKind>) -> i64 {
    match device {
        None => 0,
        Some(DeviceKind::Cpu) => 1,
        Some(DeviceKind::Gpu) => 2,
    }
}

/// Every device requirement, in the order of its codes.
pub(super) const DEVICES: [Option<DeviceKind>; 3] =
    [None, Some(DeviceKind::Cpu), Some(DeviceKind::Gpu)];

pub(super) fn device_at(row: &Row<'_>, column: usize) -> rusqlite::Result<Option<DeviceKind>> {
    from_code(row, column, &DEVICES)
}

pub(super) fn kind_code(kind: Kind) -> i64 {
    match kind {
        Kind::Pair => 0,
        Kind::Sequence => 1,
    }
}

/// Decodes a column as an index into a list of all values.
fn from_code<T: Copy>(row: &Row<'_>, column: usize, all: &[T]) -> rusqlite::Result<T> {
    let code: i64 = row.get(column)?;
    let found = usize::try_from(code).ok().and_then(|code| all.get(code));
    found
        .copied()
        .ok_or(rusqlite::Error::IntegralValueOutOfRange(column, code))
}

pub(super) fn priority_at(row: &Row<'_>, column: usize) -> rusqlite::Result<Priority> {
    from_code(row, column, &Priority::ALL)
}

pub(super) fn tenant_at(row: &Row<'_>, column: usize) -> rusqlite::Result<Tenant> {
    let name: String = row.get(column)?;
    name.parse()
        .map_err(|_| rusqlite::Error::InvalidColumnType(column, name, rusqlite::types::Type::Text))
}

/// Converts one row to a job.
pub(super) fn job(row: &Row<'_>) -> rusqlite::Result<Job> {
    let moment = |column: usize| -> rusqlite::Result<Option<Timestamp>> {
        let millis: Option<i64> = row.get(column)?;
        Ok(millis.map(Timestamp::from_millis))
    };
    let done: Option<u32> = row.get(17)?;
    let code: Option<String> = row.get(21)?;
    let parent: Option<[u8; 16]> = row.get(3)?;
    let after: Option<[u8; 16]> = row.get(29)?;
    Ok(Job {
        id: JobId::from_bytes(row.get(0)?),
        tenant: tenant_at(row, 1)?,
        kind: from_code(row, 2, &[Kind::Pair, Kind::Sequence])?,
        parent: parent.map(JobId::from_bytes),
        index: row.get(4)?,
        pairs: row.get(5)?,
        pairs_left: row.get(6)?,
        priority: priority_at(row, 7)?,
        state: from_code(row, 8, &State::ALL)?,
        durable: row.get(9)?,
        attempt: row.get(10)?,
        cost_seconds: row.get(11)?,
        options: row.get(12)?,
        created: Timestamp::from_millis(row.get(13)?),
        started: moment(14)?,
        finished: moment(15)?,
        deadline: moment(16)?,
        progress: match done {
            None => None,
            Some(done) => Some(JobProgress {
                done,
                total: row.get(18)?,
                loss: row.get(19)?,
            }),
        },
        stop_reason: row.get(20)?,
        error: match code {
            None => None,
            Some(code) => Some(JobError {
                code,
                message: row.get(22)?,
                retryable: row.get(23)?,
            }),
        },
        dead: row.get(24)?,
        cancel_requested: row.get(25)?,
        report: row.get(26)?,
        device: device_at(row, 27)?,
        backward: row.get(28)?,
        after: after.map(JobId::from_bytes),
        has_dependents: row.get(30)?,
        ready: moment(31)?,
        window: [row.get(32)?, row.get(33)?],
        crashes: row.get(34)?,
    })
}

/// The job with this id, if there is one.
pub(super) fn find(connection: &Connection, id: JobId) -> Result<Option<Job>, QueueError> {
    let sql = format!("SELECT {COLUMNS} FROM jobs INDEXED BY jobs_id WHERE id = ?1");
    let mut statement = connection.prepare_cached(&sql)?;
    Ok(statement.query_row([id.as_bytes()], job).optional()?)
}

/// The job with this id.
pub(super) fn get(connection: &Connection, id: JobId) -> Result<Job, QueueError> {
    find(connection, id)?.ok_or(QueueError::NotFound)
}

/// The pairs of a sequence, in the order of submission.
pub(super) fn pairs(connection: &Connection, parent: JobId) -> Result<Vec<Job>, QueueError> {
    let sql =
        format!("SELECT {COLUMNS} FROM jobs INDEXED BY jobs_parent WHERE parent = ?1 ORDER BY seq");
    let mut statement = connection.prepare_cached(&sql)?;
    let rows = statement.query_map([parent.as_bytes()], job)?;
    Ok(rows.collect::<rusqlite::Result<_>>()?)
}
