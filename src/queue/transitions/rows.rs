//! Conversion between rows and jobs, and the locks of rows.

use crate::clock::Timestamp;
use crate::job::{
    Delivery, DeliveryState, DeviceKind, Job, JobError, JobId, JobProgress, Kind, Priority, State,
};
use crate::queue::sql::{Row, Sql, values};
use crate::queue::types::QueueError;

/// The columns that [`job`] reads, in its order.
pub(super) const COLUMNS: &str = "id, tenant, kind, parent, pair_index, pairs, pairs_left, priority, \
    state, durable, attempt, cost, options, created, started, finished, deadline, progress_done, \
    progress_total, loss, stop_reason, error_code, error_message, error_retryable, dead, \
    cancel_requested, report, device, backward, after, has_dependents, ready, sees_from, sees_to, \
    crashes, trace, webhook, result_uri, delivery";

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

pub(super) fn kind_code(kind: Kind) -> i64 {
    match kind {
        Kind::Pair => 0,
        Kind::Sequence => 1,
    }
}

/// The code of a delivery's state: its index in [`DeliveryState::ALL`].
pub(super) fn delivery_code(state: DeliveryState) -> i64 {
    match state {
        DeliveryState::Pending => 0,
        DeliveryState::Delivered => 1,
        DeliveryState::GivenUp => 2,
    }
}

/// Converts one row to a job.
pub(super) fn job(row: &Row) -> Result<Job, QueueError> {
    let moment = |column: usize| row.get::<Option<Timestamp>>(column);
    let done: Option<u32> = row.get(17)?;
    let code: Option<String> = row.get(21)?;
    Ok(Job {
        id: row.get(0)?,
        tenant: row.get(1)?,
        kind: row.choice(2, &[Kind::Pair, Kind::Sequence])?,
        parent: row.get(3)?,
        index: row.get(4)?,
        pairs: row.get(5)?,
        pairs_left: row.get(6)?,
        priority: row.choice(7, &Priority::ALL)?,
        state: row.choice(8, &State::ALL)?,
        durable: row.get(9)?,
        attempt: row.get(10)?,
        cost_seconds: row.get(11)?,
        options: row.get(12)?,
        created: row.get(13)?,
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
        device: row.choice(27, &DEVICES)?,
        backward: row.get(28)?,
        after: row.get(29)?,
        has_dependents: row.get(30)?,
        ready: moment(31)?,
        window: [row.get(32)?, row.get(33)?],
        crashes: row.get(34)?,
        trace: row.get(35)?,
        webhook: row.get(36)?,
        delivery: match row.get(37)? {
            None => None,
            Some(uri) => Some(Delivery {
                uri,
                state: row.choice(38, &DeliveryState::ALL)?,
            }),
        },
    })
}

/// The job with this id, if there is one.
pub(in crate::queue) fn find(sql: &dyn Sql, id: JobId) -> Result<Option<Job>, QueueError> {
    let text = format!("SELECT {COLUMNS} FROM jobs INDEXED BY jobs_id WHERE id = ?1");
    sql.first(&text, values![id])?.as_ref().map(job).transpose()
}

/// The job with this id.
pub(in crate::queue) fn get(sql: &dyn Sql, id: JobId) -> Result<Job, QueueError> {
    find(sql, id)?.ok_or(QueueError::NotFound)
}

/// The pairs of a sequence, in the order of submission.
pub(in crate::queue) fn pairs(sql: &dyn Sql, parent: JobId) -> Result<Vec<Job>, QueueError> {
    read_pairs(sql, parent, "")
}

/// The job with this id, if there is one, until the commit changed by nobody else. Its sequence is
/// locked with it.
pub(super) fn lock(sql: &dyn Sql, id: JobId) -> Result<Option<Job>, QueueError> {
    // Always first the sequence and then its pairs, or two transactions might wait for each other.
    let sequence = format!(
        "SELECT {COLUMNS} FROM jobs INDEXED BY jobs_id WHERE id = coalesce((SELECT parent FROM jobs \
         INDEXED BY jobs_id WHERE id = ?1), ?1) FOR UPDATE"
    );
    let Some(first) = sql.first(&sequence, values![id])? else {
        return Ok(None);
    };
    let first = job(&first)?;
    if first.id == id {
        return Ok(Some(first));
    }
    let text = format!("SELECT {COLUMNS} FROM jobs INDEXED BY jobs_id WHERE id = ?1 FOR UPDATE");
    sql.first(&text, values![id])?.as_ref().map(job).transpose()
}

/// The same for a job that is expected.
pub(super) fn lock_known(sql: &dyn Sql, id: JobId) -> Result<Job, QueueError> {
    lock(sql, id)?.ok_or(QueueError::NotFound)
}

/// The pairs of a sequence that is locked, in the order of submission, until the commit claimed by
/// nobody.
pub(super) fn lock_pairs(sql: &dyn Sql, parent: JobId) -> Result<Vec<Job>, QueueError> {
    read_pairs(sql, parent, " FOR UPDATE")
}

fn read_pairs(sql: &dyn Sql, parent: JobId, lock: &str) -> Result<Vec<Job>, QueueError> {
    let text = format!(
        "SELECT {COLUMNS} FROM jobs INDEXED BY jobs_parent WHERE parent = ?1 ORDER BY seq{lock}"
    );
    sql.query(&text, values![parent])?.iter().map(job).collect()
}
