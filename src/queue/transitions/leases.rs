//! Leases: claiming a job, renewing its lease, and requeueing it or ending its attempt.

use std::sync::Arc;
use std::time::Duration;

use super::finish::{End, end};
use super::rows;
use super::rows::{COLUMNS, device_code};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobError, JobId, JobProgress, State};
use crate::queue::effects::Effects;
use crate::queue::sql::{Sql, values};
use crate::queue::types::{Committed, Event, Outcome, QueueError, QueueOptions};

/// The statement that finds the first ready job of one device requirement. The query plan test also
/// uses it.
pub(in crate::queue) const FIRST_READY: &str = "SELECT priority, virtual_start, seq FROM jobs \
    INDEXED BY jobs_ready WHERE state = 0 AND ready IS NOT NULL AND delayed = 0 AND device = ?1 \
    ORDER BY priority DESC, virtual_start, seq LIMIT 1";

/// What locks the job that [`FIRST_READY`] finds. A job that another transaction is claiming is
/// passed over.
const AND_LOCK: &str = " FOR UPDATE SKIP LOCKED";

/// How often a worker looks again at once where another one was faster.
const LOOKS: u32 = 3;

/// Limit and back-off of storage failures that affect a single job. With the default retry delay
/// the delays add up to about half an hour.
const MAX_DELAYS: u32 = 13;
const FIRST_DELAY: Duration = Duration::from_millis(500);
const LONGEST_DELAY: Duration = Duration::from_secs(300);

/// How often the delay of a retry doubles at most.
const MAX_DOUBLINGS: u32 = 10;

/// The longest delay of a job that is queued again.
pub(super) fn longest_delay(options: &QueueOptions) -> Duration {
    let retry = options.retry_delay.saturating_mul(1 << MAX_DOUBLINGS);
    retry.max(LONGEST_DELAY)
}

/// Sort key of a ready job: the lowest runs first.
type BacklogKey = (core::cmp::Reverse<i64>, f64, i64);

/// The first ready job among those for any device and those for this kind. Two index lookups, so
/// that the jobs that wait for the other kind cost nothing.
fn first_ready(sql: &dyn Sql, kind: DeviceKind) -> Result<Option<i64>, QueueError> {
    let find = |need, lock: &str| -> Result<Option<BacklogKey>, QueueError> {
        let text = format!("{FIRST_READY}{lock}");
        match sql.first(&text, values![device_code(need)])? {
            None => Ok(None),
            Some(row) => Ok(Some((
                core::cmp::Reverse(row.get(0)?),
                row.get(1)?,
                row.get(2)?,
            ))),
        }
    };
    for _ in 0..LOOKS {
        // A job of the class that is not chosen must not be hidden from other workers by a lock.
        let (any, own) = match find(Some(kind), "")? {
            None => (None, None),
            own => (find(None, "")?, own),
        };
        let prefers_own = own.is_some() && any.is_none_or(|any| own.is_some_and(|own| own < any));
        let need = prefers_own.then_some(kind);
        match find(need, AND_LOCK)? {
            Some((_, _, seq)) => return Ok(Some(seq)),
            // Others are claiming all that there is.
            None if own.is_none() => return Ok(None),
            None => {}
        }
    }
    Ok(None)
}

/// Leases the next job to `worker`, whose device is of this kind.
pub(in crate::queue) fn claim(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    worker: &str,
    kind: DeviceKind,
) -> Result<Option<Arc<Job>>, QueueError> {
    sql.check_node()?;
    let Some(seq) = first_ready(sql, kind)? else {
        return Ok(None);
    };
    let now = sql.now();
    let text = format!(
        "UPDATE jobs SET state = 1, attempt = attempt + 1, worker = ?1, holder = ?2, due = ?3, \
         started = coalesce(started, ?4) WHERE seq = ?5 RETURNING {COLUMNS}"
    );
    let until = now.after(options.lease);
    let row = sql.first(&text, values![worker, sql.node(), until, now, seq])?;
    let Some(row) = row else {
        return Ok(None);
    };
    let mut job = rows::job(&row)?;
    // The worker compares it with its own clock.
    let by_own_clock = |deadline: Timestamp| deadline.on_clock_ahead(-sql.ahead_ms());
    job.deadline = job.deadline.map(by_own_clock);
    let job = Arc::new(job);
    effects.left.push(Arc::clone(&job));
    effects.started.push(Arc::clone(&job));
    effects.changed.push(Arc::clone(&job));
    if job.attempt == 1 {
        effects.events.push(Event::Started(Arc::clone(&job)));
    }
    if let Some(parent) = job.parent {
        // A transaction that holds the sequence may be waiting for this pair. The sequence is then
        // left as it is, and the claim of its next pair starts it.
        let text = format!(
            "UPDATE jobs SET state = 1, started = coalesce(started, ?2) WHERE id = (SELECT id FROM \
             jobs INDEXED BY jobs_id WHERE id = ?1 AND state = 0 FOR UPDATE SKIP LOCKED) \
             RETURNING {COLUMNS}"
        );
        if let Some(begun) = sql.first(&text, values![parent, now])? {
            effects.changed.push(Arc::new(rows::job(&begun)?));
        }
    }
    Ok(Some(job))
}

/// Renews a lease and records progress. No effect if the lease is lost.
pub(in crate::queue) fn beat(
    sql: &dyn Sql,
    options: &QueueOptions,
    id: JobId,
    attempt: u32,
    progress: Option<JobProgress>,
) -> Result<(), QueueError> {
    let text = "UPDATE jobs SET due = ?3, progress_done = coalesce(?4, progress_done), \
               progress_total = coalesce(?5, progress_total), loss = coalesce(?6, loss) \
               WHERE id = ?1 AND attempt = ?2 AND state = 1";
    let parameters = values![
        id,
        attempt,
        sql.now().after(options.lease),
        progress.map(|progress| progress.done),
        progress.map(|progress| progress.total),
        progress.map(|progress| progress.loss),
    ];
    sql.query(text, parameters)?;
    Ok(())
}

/// Sets the remaining lease of a job whose worker is alive.
pub(super) fn prolong(sql: &dyn Sql, id: JobId, left: Duration) -> Result<(), QueueError> {
    let text = "UPDATE jobs SET due = ?2 WHERE id = ?1 AND state = 1";
    sql.query(text, values![id, sql.now().after(left)])?;
    Ok(())
}

/// Resets the crash counter after a snapshot.
pub(in crate::queue) fn snapshot_kept(
    sql: &dyn Sql,
    id: JobId,
    attempt: u32,
) -> Result<(), QueueError> {
    let text = "UPDATE jobs SET crashes = 0 WHERE id = ?1 AND attempt = ?2 AND state = 1";
    sql.query(text, values![id, attempt])?;
    Ok(())
}

/// Ends an attempt. The attempt number is the fencing token: only the attempt that holds the job
/// counts.
pub(in crate::queue) fn finish(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
    attempt: u32,
    outcome: Outcome,
) -> Result<Committed, QueueError> {
    let job = match rows::lock(sql, id)? {
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
            end(sql, effects, options, &job, State::Cancelled, &how)?
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
            end(sql, effects, options, &job, State::Succeeded, &how)?
        }
        Outcome::Released => requeue_running(sql, effects, &job, Duration::ZERO)?,
        Outcome::Moved(kind) => {
            let text = "UPDATE jobs SET device = ?2 WHERE id = ?1";
            sql.query(text, values![id, device_code(Some(kind))])?;
            let job = rows::get(sql, id)?;
            requeue_running(sql, effects, &job, Duration::ZERO)?
        }
        Outcome::Delayed(error) => delay(sql, effects, options, &job, error)?,
        Outcome::Crashed(error) => crash(sql, effects, options, &job, error)?,
        Outcome::Failed(error) => fail(sql, effects, options, &job, error)?,
    };
    Ok(Committed::Yes(state))
}

/// Counts a failure: the job is retried after a delay, or ends.
pub(super) fn fail(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let failures = count(sql, job, "failures")?;
    if error.retryable && failures < options.max_attempts {
        let doublings = (failures - 1).min(MAX_DOUBLINGS);
        let delay = options.retry_delay.saturating_mul(1 << doublings);
        return requeue_running(sql, effects, job, delay);
    }
    let is_dead = error.retryable;
    give_up(sql, effects, options, job, error, is_dead)
}

/// Counts a storage failure that affects only this job: it is requeued with growing delays, and
/// becomes a dead letter in the end.
fn delay(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let delays = count(sql, job, "delays")?;
    if delays < MAX_DELAYS {
        let first = FIRST_DELAY.max(options.retry_delay);
        let longer = first.saturating_mul(1 << delays.min(12)).min(LONGEST_DELAY);
        return requeue_running(sql, effects, job, longer);
    }
    give_up(sql, effects, options, job, error, true)
}

/// Counts a crash: the job is retried at once, or becomes a dead letter.
pub(super) fn crash(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let crashes = count(sql, job, "crashes")?;
    if crashes < options.max_crashes {
        return requeue_running(sql, effects, job, Duration::ZERO);
    }
    give_up(sql, effects, options, job, error, true)
}

/// Increments a counter column of a job and returns its new value.
fn count(sql: &dyn Sql, job: &Job, counter: &str) -> Result<u32, QueueError> {
    let text =
        format!("UPDATE jobs SET {counter} = {counter} + 1 WHERE id = ?1 RETURNING {counter}");
    sql.only(&text, values![job.id])?.get(0)
}

/// Ends a job that failed. `dead`: as a dead letter.
fn give_up(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
    dead: bool,
) -> Result<State, QueueError> {
    let how = End {
        error: Some(error),
        dead,
        ..End::default()
    };
    end(sql, effects, options, job, State::Failed, &how)
}

/// Requeues a running job at its previous position. The attempt that held it is fenced off.
pub(super) fn requeue_running(
    sql: &dyn Sql,
    effects: &mut Effects,
    job: &Job,
    delay: Duration,
) -> Result<State, QueueError> {
    let text = format!(
        "UPDATE jobs SET state = 0, worker = NULL, delayed = ?2, \
         due = CASE WHEN ?2 = 1 AND ?3 < expires THEN ?3 ELSE expires END \
         WHERE id = ?1 RETURNING {COLUMNS}"
    );
    let until = sql.now().after(delay);
    let row = sql.only(&text, values![job.id, !delay.is_zero(), until])?;
    let queued = Arc::new(rows::job(&row)?);
    effects.stopped.push(Arc::clone(&queued));
    effects.entered.push(Arc::clone(&queued));
    effects.changed.push(Arc::clone(&queued));
    effects.events.push(Event::Requeued(queued));
    Ok(State::Queued)
}
