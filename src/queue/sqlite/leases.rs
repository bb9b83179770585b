//! Leases: claiming a job, renewing its lease, and requeueing it or ending its attempt.

use std::sync::Arc;
use std::time::Duration;

use rusqlite::{Connection, OptionalExtension, params};

use super::effects::Effects;
use super::finish::{End, end};
use super::rows;
use super::rows::{COLUMNS, device_code};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobError, JobId, JobProgress, State};
use crate::queue::types::{Committed, Event, Outcome, QueueError, QueueOptions};

/// The statement that finds the first ready job of one device requirement. The query plan test also
/// uses it.
pub(super) const FIRST_READY: &str = "SELECT priority, virtual_start, seq FROM jobs \
    INDEXED BY jobs_ready WHERE state = 0 AND ready IS NOT NULL AND delayed = 0 AND device = ?1 \
    ORDER BY priority DESC, virtual_start, seq LIMIT 1";

/// Limit and back-off of storage failures that affect a single job. With the default retry delay
/// the delays add up to about half an hour.
const MAX_DELAYS: u32 = 13;
const FIRST_DELAY: Duration = Duration::from_millis(500);
const LONGEST_DELAY: Duration = Duration::from_secs(300);

/// Sort key of a ready job: the lowest runs first.
type BacklogKey = (core::cmp::Reverse<i64>, f64, i64);

/// The first ready job among those for any device and those for this kind. Two index lookups, so
/// that the jobs that wait for the other kind cost nothing.
fn first_ready(connection: &Connection, kind: DeviceKind) -> Result<Option<i64>, QueueError> {
    let mut statement = connection.prepare_cached(FIRST_READY)?;
    let mut first: Option<BacklogKey> = None;
    for need in [None, Some(kind)] {
        let found: Option<BacklogKey> = statement
            .query_row([device_code(need)], |row| {
                Ok((core::cmp::Reverse(row.get(0)?), row.get(1)?, row.get(2)?))
            })
            .optional()?;
        let earlier = |one: BacklogKey, other: BacklogKey| if other < one { other } else { one };
        first = first.into_iter().chain(found).reduce(earlier);
    }
    Ok(first.map(|(_, _, seq)| seq))
}

/// Leases the next job to `worker`, whose device is of this kind.
pub(super) fn claim(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    worker: &str,
    kind: DeviceKind,
) -> Result<Option<Arc<Job>>, QueueError> {
    let Some(seq) = first_ready(connection, kind)? else {
        return Ok(None);
    };
    let now = Timestamp::now();
    let sql = format!(
        "UPDATE jobs SET state = 1, attempt = attempt + 1, worker = ?1, due = ?2, \
         started = coalesce(started, ?3) WHERE seq = ?4 RETURNING {COLUMNS}"
    );
    let mut statement = connection.prepare_cached(&sql)?;
    let until = now.after(options.lease).as_millis();
    let job = statement
        .query_row(params![worker, until, now.as_millis(), seq], rows::job)
        .optional()?;
    let Some(job) = job.map(Arc::new) else {
        return Ok(None);
    };
    effects.left.push(Arc::clone(&job));
    effects.started.push(Arc::clone(&job));
    effects.changed.push(Arc::clone(&job));
    if job.attempt == 1 {
        effects.events.push(Event::Started(Arc::clone(&job)));
    }
    if let Some(parent) = job.parent {
        let sql = format!(
            "UPDATE jobs SET state = 1, started = coalesce(started, ?2) \
             WHERE id = ?1 AND state = 0 RETURNING {COLUMNS}"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let begun = statement
            .query_row(params![parent.as_bytes(), now.as_millis()], rows::job)
            .optional()?;
        effects.changed.extend(begun.map(Arc::new));
    }
    Ok(Some(job))
}

/// Renews a lease and records progress. No effect if the lease is lost.
pub(super) fn beat(
    connection: &Connection,
    options: &QueueOptions,
    id: JobId,
    attempt: u32,
    progress: Option<JobProgress>,
) -> Result<(), QueueError> {
    let sql = "UPDATE jobs SET due = ?3, progress_done = coalesce(?4, progress_done), \
               progress_total = coalesce(?5, progress_total), loss = coalesce(?6, loss) \
               WHERE id = ?1 AND attempt = ?2 AND state = 1";
    connection.prepare_cached(sql)?.execute(params![
        id.as_bytes(),
        attempt,
        Timestamp::now().after(options.lease).as_millis(),
        progress.map(|progress| progress.done),
        progress.map(|progress| progress.total),
        progress.map(|progress| progress.loss),
    ])?;
    Ok(())
}

/// Sets the remaining lease of a job whose worker is alive.
pub(super) fn prolong(
    connection: &Connection,
    id: JobId,
    left: Duration,
) -> Result<(), QueueError> {
    let until = Timestamp::now().after(left).as_millis();
    connection
        .prepare_cached("UPDATE jobs SET due = ?2 WHERE id = ?1 AND state = 1")?
        .execute(params![id.as_bytes(), until])?;
    Ok(())
}

/// Resets the crash counter after a snapshot.
pub(super) fn snapshot_kept(
    connection: &Connection,
    id: JobId,
    attempt: u32,
) -> Result<(), QueueError> {
    let sql = "UPDATE jobs SET crashes = 0 WHERE id = ?1 AND attempt = ?2 AND state = 1";
    connection
        .prepare_cached(sql)?
        .execute(params![id.as_bytes(), attempt])?;
    Ok(())
}

/// Ends an attempt. The attempt number is the fencing token: only the attempt that holds the job
/// counts.
pub(super) fn finish(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
    attempt: u32,
    outcome: Outcome,
) -> Result<Committed, QueueError> {
    let job = match rows::find(connection, id)? {
        Some(job) if job.state == State::Running && job.attempt == attempt => job,
        _ => return Ok(Committed::Fenced),
    };
    // Any outcome after a cancellation request counts as cancelled.
    let outcome = if job.cancel_requested {
        Outcome::Cancelled
    } else {
        outcome
    };
    let state = match outcome {
        Outcome::Cancelled => {
            let how = End::default();
            end(connection, effects, options, &job, State::Cancelled, &how)?
        }
        Outcome::Succeeded {
            stop_reason,
            report,
            progress,
        } => {
            let how = End {
                stop_reason,
                report: Some(report),
                progress,
                ..End::default()
            };
            end(connection, effects, options, &job, State::Succeeded, &how)?
        }
        Outcome::Released => requeue_running(connection, effects, &job, Duration::ZERO)?,
        Outcome::Moved(kind) => {
            let sql = "UPDATE jobs SET device = ?2 WHERE id = ?1";
            connection
                .prepare_cached(sql)?
                .execute(params![id.as_bytes(), device_code(Some(kind))])?;
            let job = rows::get(connection, id)?;
            requeue_running(connection, effects, &job, Duration::ZERO)?
        }
        Outcome::Delayed(error) => delay(connection, effects, options, &job, error)?,
        Outcome::Crashed(error) => crash(connection, effects, options, &job, error)?,
        Outcome::Failed(error) => fail(connection, effects, options, &job, error)?,
    };
    Ok(Committed::Yes(state))
}

/// Counts a failure: the job is retried after a delay, or ends.
pub(super) fn fail(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let failures = count(connection, job, "failures")?;
    if error.retryable && failures < options.max_attempts {
        let doublings = (failures - 1).min(10);
        let delay = options.retry_delay.saturating_mul(1 << doublings);
        return requeue_running(connection, effects, job, delay);
    }
    let how = End {
        dead: error.retryable,
        error: Some(error),
        ..End::default()
    };
    end(connection, effects, options, job, State::Failed, &how)
}

/// Counts a storage failure that affects only this job: it is requeued with growing delays, and
/// becomes a dead letter in the end.
fn delay(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let delays = count(connection, job, "delays")?;
    if delays < MAX_DELAYS {
        let first = FIRST_DELAY.max(options.retry_delay);
        let longer = first.saturating_mul(1 << delays.min(12)).min(LONGEST_DELAY);
        return requeue_running(connection, effects, job, longer);
    }
    give_up(connection, effects, options, job, error)
}

/// Counts a crash: the job is retried at once, or becomes a dead letter.
pub(super) fn crash(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let crashes = count(connection, job, "crashes")?;
    if crashes < options.max_crashes {
        return requeue_running(connection, effects, job, Duration::ZERO);
    }
    give_up(connection, effects, options, job, error)
}

/// Increments a counter column of a job and returns its new value.
fn count(connection: &Connection, job: &Job, counter: &str) -> Result<u32, QueueError> {
    let sql =
        format!("UPDATE jobs SET {counter} = {counter} + 1 WHERE id = ?1 RETURNING {counter}");
    let mut statement = connection.prepare_cached(&sql)?;
    Ok(statement.query_row([job.id.as_bytes()], |row| row.get(0))?)
}

/// Ends a job as a dead letter.
fn give_up(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let how = End {
        error: Some(error),
        dead: true,
        ..End::default()
    };
    end(connection, effects, options, job, State::Failed, &how)
}

/// Requeues a running job at its previous position. The attempt that held it is fenced off.
pub(super) fn requeue_running(
    connection: &Connection,
    effects: &mut Effects,
    job: &Job,
    delay: Duration,
) -> Result<State, QueueError> {
    let sql = format!(
        "UPDATE jobs SET state = 0, worker = NULL, delayed = ?2, \
         due = CASE WHEN ?2 THEN min(?3, expires) ELSE expires END \
         WHERE id = ?1 RETURNING {COLUMNS}"
    );
    let until = Timestamp::now().after(delay).as_millis();
    let mut statement = connection.prepare_cached(&sql)?;
    let parameters = params![job.id.as_bytes(), !delay.is_zero(), until];
    let queued = Arc::new(statement.query_row(parameters, rows::job)?);
    effects.stopped.push(Arc::clone(&queued));
    effects.entered.push(Arc::clone(&queued));
    effects.changed.push(Arc::clone(&queued));
    effects.events.push(Event::Requeued(queued));
    Ok(State::Queued)
}
