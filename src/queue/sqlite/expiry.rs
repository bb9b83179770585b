//! Expiry of deadlines, retry delays, leases and retention times, and the recovery after a restart.

use std::sync::Arc;
use std::time::Duration;

use rusqlite::{Connection, OptionalExtension, params};

use super::effects::Effects;
use super::finish::End;
use super::rows::COLUMNS;
use super::{fair_queue, finish, leases, rows};
use crate::clock::Timestamp;
use crate::job::{Job, JobError, JobId, State};
use crate::queue::types::{Event, QueueError, QueueOptions};

/// Due rows that one pass handles.
const AT_ONCE: u32 = 256;

/// The time of the next due row.
pub(super) fn next_due(connection: &Connection) -> Result<Option<Timestamp>, QueueError> {
    let sql = "SELECT min(due) FROM jobs INDEXED BY jobs_due WHERE due IS NOT NULL";
    let due: Option<i64> = connection
        .prepare_cached(sql)?
        .query_row([], |row| row.get(0))?;
    Ok(due.map(Timestamp::from_millis))
}

/// Handles every row that is due. `lease_left` returns the remaining lease of a running job by its
/// worker's heartbeats, or `None` if the lease has expired.
pub(super) fn sweep(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    lease_left: impl Fn(JobId) -> Option<Duration>,
) -> Result<(), QueueError> {
    let now = Timestamp::now();
    let sql = format!(
        "SELECT {COLUMNS} FROM jobs INDEXED BY jobs_due WHERE due <= ?1 ORDER BY due LIMIT {AT_ONCE}"
    );
    let due: Vec<Job> = {
        let mut statement = connection.prepare_cached(&sql)?;
        let rows = statement.query_map([now.as_millis()], rows::job)?;
        rows.collect::<rusqlite::Result<_>>()?
    };
    for job in due {
        let left = lease_left(job.id);
        match job.state {
            State::Queued => look_after_queued(connection, effects, options, &job, now)?,
            State::Running if let Some(left) = left => leases::prolong(connection, job.id, left)?,
            State::Running if job.cancel_requested => {
                let how = End::default();
                finish::end(connection, effects, options, &job, State::Cancelled, &how)?;
            }
            State::Running => {
                effects.events.push(Event::LeaseExpired(job.id));
                let error = JobError {
                    code: "lease_expired".to_owned(),
                    message: "the device gave no sign of life".to_owned(),
                    retryable: true,
                };
                leases::fail(connection, effects, options, &job, error)?;
            }
            _ => forget_or_keep(connection, effects, options, &job)?,
        }
    }
    Ok(())
}

/// Handles a queued job whose retry delay has ended or that has expired.
fn look_after_queued(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    now: Timestamp,
) -> Result<(), QueueError> {
    // Its tag may date from a time when the virtual time was later; then it would wait
    // indefinitely.
    let sql = "UPDATE jobs SET delayed = 0, due = expires, \
               virtual_start = min(virtual_start, ?3), virtual_finish = min(virtual_start, ?3) + cost \
               WHERE id = ?1 AND expires > ?2";
    let served = fair_queue::virtual_now(connection, job.priority)?.unwrap_or(0.0);
    let woken = connection.prepare_cached(sql)?.execute(params![
        job.id.as_bytes(),
        now.as_millis(),
        served
    ])?;
    if woken > 0 {
        effects
            .changed
            .push(Arc::new(rows::get(connection, job.id)?));
        return Ok(());
    }
    let (code, message) = match job.deadline {
        Some(_) => (
            "deadline_in_queue",
            "the deadline passed before a device was free",
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
    finish::end(connection, effects, options, job, State::Expired, &how)?;
    Ok(())
}

/// Removes an ended job before its retention is over.
pub(super) fn remove(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
) -> Result<(), QueueError> {
    let job = rows::get(connection, id)?;
    match job.parent {
        Some(sequence) => Err(QueueError::PairOfSequence(sequence)),
        None if !job.state.is_end() => Err(QueueError::NotEnded(job.state)),
        None => forget_or_keep(connection, effects, options, &job),
    }
}

/// Removes an ended job whose retention is over. It is kept for longer while a job that follows it
/// may still use its results.
fn forget_or_keep(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
) -> Result<(), QueueError> {
    if fair_queue::followers(connection, job.id)?.is_empty() {
        return forget(connection, effects, job.id);
    }
    let sql = "UPDATE jobs SET due = ?2 WHERE id = ?1";
    let later = Timestamp::now().after(options.answered_retention);
    connection
        .prepare_cached(sql)?
        .execute(params![job.id.as_bytes(), later.as_millis()])?;
    Ok(())
}

/// Removes an ended job and its pairs.
fn forget(connection: &Connection, effects: &mut Effects, id: JobId) -> Result<(), QueueError> {
    for pair in rows::pairs(connection, id)? {
        effects.events.push(Event::Deleted(pair.id));
    }
    let sql = "DELETE FROM jobs WHERE parent = ?1";
    connection.prepare_cached(sql)?.execute([id.as_bytes()])?;
    let sql = "DELETE FROM jobs WHERE id = ?1";
    connection.prepare_cached(sql)?.execute([id.as_bytes()])?;
    effects.events.push(Event::Deleted(id));
    Ok(())
}

/// Recovery after a restart. Running jobs are requeued at once, since no other process can hold
/// them. Ephemeral jobs are forgotten, since their callers' connections are gone. After an
/// `orderly` shutdown no crash is counted.
pub(super) fn recover(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    orderly: bool,
) -> Result<(), QueueError> {
    let sql = format!(
        "SELECT {COLUMNS} FROM jobs INDEXED BY jobs_running WHERE state = 1 AND ready IS NOT NULL"
    );
    let running: Vec<Job> = {
        let mut statement = connection.prepare_cached(&sql)?;
        let rows = statement.query_map([], rows::job)?;
        rows.collect::<rusqlite::Result<_>>()?
    };
    for job in running {
        if job.cancel_requested {
            let how = End::default();
            finish::end(connection, effects, options, &job, State::Cancelled, &how)?;
            continue;
        }
        if orderly {
            // The shutdown could not release it, and it has not crashed the process.
            leases::requeue_running(connection, effects, &job, Duration::ZERO)?;
            continue;
        }
        let error = JobError {
            code: "crashed".to_owned(),
            message: "the process died again and again while it worked on this job".to_owned(),
            retryable: true,
        };
        leases::crash(connection, effects, options, &job, error)?;
    }
    let sql = "SELECT id FROM jobs WHERE durable = 0 AND parent IS NULL AND state < 2";
    let abandoned: Vec<[u8; 16]> = {
        let mut statement = connection.prepare(sql)?;
        let rows = statement.query_map([], |row| row.get(0))?;
        rows.collect::<rusqlite::Result<_>>()?
    };
    for id in abandoned {
        let id = JobId::from_bytes(id);
        fair_queue::release_followers(connection, effects, &rows::get(connection, id)?)?;
        forget(connection, effects, id)?;
    }
    Ok(())
}

/// The earliest time since which a queued job has been ready to be leased.
pub(super) fn oldest_queued(connection: &Connection) -> Result<Option<Timestamp>, QueueError> {
    let sql = "SELECT ready FROM jobs INDEXED BY jobs_age \
               WHERE state = 0 AND ready IS NOT NULL ORDER BY ready LIMIT 1";
    let ready: Option<i64> = connection
        .prepare_cached(sql)?
        .query_row([], |row| row.get(0))
        .optional()?;
    Ok(ready.map(Timestamp::from_millis))
}
