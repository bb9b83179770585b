//! Expiry of deadlines, retry delays, leases and retention times, and the recovery of the jobs of a
//! process that has ended.

use std::sync::Arc;
use std::time::Duration;

use super::finish::End;
use super::{fair_queue, finish, leases, outbox, rows};
use crate::clock::Timestamp;
use crate::job::{Job, JobError, JobId, Kind, State};
use crate::queue::effects::Effects;
use crate::queue::sql::{Sql, values};
use crate::queue::types::{Event, QueueError, QueueOptions};

/// Due rows of each kind that one pass handles.
const AT_ONCE: u32 = 256;

/// The statement that finds the open jobs whose rows are due. The query plan test also uses it.
pub(in crate::queue) const DUE_OPEN: &str = "SELECT id FROM jobs INDEXED BY jobs_open_due \
    WHERE due <= ?1 AND due IS NOT NULL AND state < 2 ORDER BY due LIMIT ?2";

/// The same for the jobs that have ended.
pub(in crate::queue) const DUE_ENDED: &str = "SELECT id FROM jobs INDEXED BY jobs_due \
    WHERE due <= ?1 AND state > 1 ORDER BY due LIMIT ?2";

/// The statement that finds the time of the next due row. The query plan test also uses it.
pub(in crate::queue) const NEXT_DUE: &str =
    "SELECT min(due) FROM jobs INDEXED BY jobs_due WHERE due IS NOT NULL";

/// The time of the next due row.
pub(in crate::queue) fn next_due(sql: &dyn Sql) -> Result<Option<Timestamp>, QueueError> {
    sql.only(NEXT_DUE, &[])?.get(0)
}

/// The jobs whose rows are due, the earliest first.
#[derive(Debug)]
pub(in crate::queue) struct Due {
    /// Jobs whose lease, retry delay or time in the queue has ended.
    pub(in crate::queue) open: Vec<JobId>,
    /// Jobs whose retention has ended. They are less urgent than the open jobs.
    pub(in crate::queue) ended: Vec<JobId>,
    /// Whether more of them are due than one pass handles.
    pub(in crate::queue) has_more: bool,
}

/// The jobs whose rows are due.
pub(in crate::queue) fn due(sql: &dyn Sql) -> Result<Due, QueueError> {
    let find = |text: &str| -> Result<Vec<JobId>, QueueError> {
        let rows = sql.query(text, values![sql.now(), AT_ONCE])?;
        rows.iter().map(|row| row.get(0)).collect()
    };
    let is_full = |found: &[JobId]| found.len() >= AT_ONCE as usize;
    let open = find(DUE_OPEN)?;
    let ended = match is_full(&open) {
        true => Vec::new(),
        false => find(DUE_ENDED)?,
    };
    let has_more = is_full(&open) || is_full(&ended);
    Ok(Due {
        open,
        ended,
        has_more,
    })
}

/// Handles a job if its row is due. `lease_left` is the remaining lease of a running job by its
/// worker's heartbeats, or `None` if the lease has expired.
pub(in crate::queue) fn look_after(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
    lease_left: Option<Duration>,
) -> Result<(), QueueError> {
    let Some(job) = rows::lock(sql, id)? else {
        return Ok(());
    };
    let now = sql.now();
    let is_due = "SELECT id FROM jobs INDEXED BY jobs_id WHERE id = ?1 AND due <= ?2";
    if sql.first(is_due, values![id, now])?.is_none() {
        return Ok(());
    }
    match job.state {
        State::Queued => look_after_queued(sql, effects, options, &job, now),
        State::Running => match lease_left {
            Some(left) => leases::prolong(sql, id, left),
            None => take_back(sql, effects, options, &job),
        },
        _ if outbox::is_delivering(sql, id)? => put_off(sql, options, id),
        _ => forget_or_keep(sql, effects, options, &job),
    }
}

/// Ends the attempt of a running job whose lease has expired.
fn take_back(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
) -> Result<(), QueueError> {
    if job.cancel_requested {
        let how = End::default();
        finish::end(sql, effects, options, job, State::Cancelled, &how)?;
        return Ok(());
    }
    effects.events.push(Event::LeaseExpired(job.id));
    let error = JobError {
        code: "lease_expired".to_owned(),
        message: "the worker sent no heartbeat".to_owned(),
        retryable: true,
    };
    leases::fail(sql, effects, options, job, error)?;
    Ok(())
}

/// Handles a queued job whose retry delay has ended or that has expired.
fn look_after_queued(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    now: Timestamp,
) -> Result<(), QueueError> {
    // Its tag may date from a time when the virtual time was later; then it would wait
    // indefinitely.
    let text = "UPDATE jobs SET delayed = 0, due = expires, \
                virtual_start = CASE WHEN virtual_start < ?3 THEN virtual_start ELSE ?3 END, \
                virtual_finish = cost + CASE WHEN virtual_start < ?3 THEN virtual_start ELSE ?3 END \
                WHERE id = ?1 AND expires > ?2 RETURNING id";
    let served = fair_queue::virtual_now(sql, job.priority)?.unwrap_or(0.0);
    if sql.first(text, values![job.id, now, served])?.is_some() {
        effects.changed.push(Arc::new(rows::get(sql, job.id)?));
        return Ok(());
    }
    let (code, message) = match job.deadline {
        Some(_) => (
            "deadline_in_queue",
            "the deadline passed before the work began",
        ),
        None => (
            "too_old",
            "no device was free for as long as a job may wait",
        ),
    };
    let error = JobError {
        code: code.to_owned(),
        message: message.to_owned(),
        retryable: true,
    };
    let how = End {
        error: Some(error),
        ..End::default()
    };
    finish::end(sql, effects, options, job, State::Expired, &how)?;
    Ok(())
}

/// Removes an ended job before its retention is over.
pub(in crate::queue) fn remove(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
) -> Result<(), QueueError> {
    let job = rows::lock_known(sql, id)?;
    match job.parent {
        Some(sequence) => Err(QueueError::PairOfSequence(sequence)),
        None if !job.state.is_end() => Err(QueueError::NotEnded(job.state)),
        None => forget_or_keep(sql, effects, options, &job),
    }
}

/// Begins the retention of an ended ephemeral job anew.
pub(in crate::queue) fn keep(
    sql: &dyn Sql,
    options: &QueueOptions,
    id: JobId,
) -> Result<(), QueueError> {
    let job = rows::lock_known(sql, id)?;
    if job.state.is_end() && !job.durable && job.parent.is_none() {
        put_off(sql, options, id)?;
    }
    Ok(())
}

/// Lets a job be deleted only after the retention of answered jobs from now on.
fn put_off(sql: &dyn Sql, options: &QueueOptions, id: JobId) -> Result<(), QueueError> {
    let later = sql.now().after(options.answered_retention);
    sql.query("UPDATE jobs SET due = ?2 WHERE id = ?1", values![id, later])?;
    Ok(())
}

/// Removes an ended job whose retention is over. It is kept for longer while a job that follows it
/// may still use its results.
fn forget_or_keep(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
) -> Result<(), QueueError> {
    if fair_queue::followers(sql, job.id)?.is_empty() {
        return forget(sql, effects, job.id);
    }
    put_off(sql, options, job.id)
}

/// Removes an ended job and its pairs.
fn forget(sql: &dyn Sql, effects: &mut Effects, id: JobId) -> Result<(), QueueError> {
    for removed in outbox::remove_files(sql, id)? {
        effects.events.push(Event::Deleted(removed));
    }
    sql.query("DELETE FROM jobs WHERE parent = ?1", values![id])?;
    sql.query("DELETE FROM jobs WHERE id = ?1", values![id])?;
    sql.query("DELETE FROM labels WHERE job = ?1", values![id])?;
    Ok(())
}

/// The jobs that a process left behind which ran as this node: those that its workers held, then
/// the ephemeral ones that it accepted.
pub(in crate::queue) fn left_behind(sql: &dyn Sql, node: i64) -> Result<Vec<JobId>, QueueError> {
    let held = "SELECT id FROM jobs INDEXED BY jobs_running \
                WHERE state = 1 AND ready IS NOT NULL AND holder = ?1";
    let accepted = "SELECT id FROM jobs INDEXED BY jobs_ephemeral \
                    WHERE durable = 0 AND parent IS NULL AND state < 2 AND origin = ?1";
    let mut found = Vec::new();
    for text in [held, accepted] {
        for row in sql.query(text, values![node])? {
            found.push(row.get(0)?);
        }
    }
    Ok(found)
}

/// Recovers a job that the process of `node` left behind. A running job is requeued, since that
/// process does not hold it any more. An ephemeral job that it accepted is deleted, since the
/// caller's connection is gone. After an `orderly` shutdown no crash is counted.
pub(in crate::queue) fn recover(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
    node: i64,
    orderly: bool,
) -> Result<(), QueueError> {
    let Some(job) = rows::lock(sql, id)? else {
        return Ok(());
    };
    let text = "SELECT origin, holder FROM jobs INDEXED BY jobs_id WHERE id = ?1";
    let row = sql.only(text, values![id])?;
    let (origin, holder): (i64, Option<i64>) = (row.get(0)?, row.get(1)?);
    if job.state == State::Running && job.ready.is_some() && holder == Some(node) {
        if job.cancel_requested {
            let how = End::default();
            finish::end(sql, effects, options, &job, State::Cancelled, &how)?;
        } else if orderly {
            // The shutdown could not release it, and it has not crashed the process.
            leases::requeue_running(sql, effects, &job, Duration::ZERO)?;
        } else {
            let error = JobError {
                code: "crashed".to_owned(),
                message: "the process died again and again while it worked on this job".to_owned(),
                retryable: true,
            };
            leases::crash(sql, effects, options, &job, error)?;
        }
    }
    let job = rows::get(sql, id)?;
    let is_abandoned = origin == node && !job.durable && job.parent.is_none();
    if is_abandoned && !job.state.is_end() {
        for job in rows::lock_pairs(sql, id)?.into_iter().chain([job.clone()]) {
            // A sequence counts in the load only while its closing job is queued or running.
            let counts = job.kind == Kind::Pair || job.ready.is_some();
            match job.state {
                State::Queued if counts => effects.left.push(Arc::new(job)),
                State::Running if counts => effects.stopped.push(Arc::new(job)),
                _ => {}
            }
        }
        fair_queue::release_followers(sql, effects, &job)?;
        forget(sql, effects, id)?;
    }
    Ok(())
}

/// The statement that finds the job that has been ready for longest. The query plan test also uses
/// it.
pub(in crate::queue) const OLDEST: &str = "SELECT ready FROM jobs INDEXED BY jobs_age \
    WHERE state = 0 AND ready IS NOT NULL ORDER BY ready LIMIT 1";

/// The earliest time since which a queued job has been ready to be leased.
pub(in crate::queue) fn oldest_queued(sql: &dyn Sql) -> Result<Option<Timestamp>, QueueError> {
    let row = sql.first(OLDEST, &[])?;
    row.map(|row| row.get(0)).transpose()
}
