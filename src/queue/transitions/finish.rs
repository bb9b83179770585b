//! Ends of jobs, by outcome or cancellation, and requeueing of ended jobs.

use std::sync::Arc;

use super::rows::{COLUMNS, state_code};
use super::{fair_queue, outbox, rows};
use crate::job::{Job, JobError, JobId, JobProgress, Kind, State};
use crate::queue::effects::Effects;
use crate::queue::sql::{Sql, values};
use crate::queue::types::{Event, QueueError, QueueOptions};

/// Details of a job's end.
#[derive(Debug, Default)]
pub(super) struct End {
    pub(super) stop_reason: Option<String>,
    pub(super) report: Option<String>,
    pub(super) progress: Option<JobProgress>,
    pub(super) error: Option<JobError>,
    pub(super) dead: bool,
}

/// Ends a queued or running job, and closes its sequence with the last pair.
pub(super) fn end(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    state: State,
    how: &End,
) -> Result<State, QueueError> {
    let now = sql.now();
    let kept = if job.durable {
        options.retention
    } else {
        options.answered_retention
    };
    // A pair is deleted with its sequence.
    let forget = job.parent.is_none().then(|| now.after(kept));
    let text = format!(
        "UPDATE jobs SET state = ?2, finished = ?3, due = ?4, stop_reason = ?5, report = ?6, \
         error_code = ?7, error_message = ?8, error_retryable = ?9, dead = ?10, worker = NULL, \
         delayed = 0, progress_done = coalesce(?11, progress_done), \
         progress_total = coalesce(?12, progress_total), loss = coalesce(?13, loss) \
         WHERE id = ?1 RETURNING {COLUMNS}"
    );
    let error = how.error.as_ref();
    let row = sql.only(
        &text,
        values![
            job.id,
            state_code(state),
            now,
            forget,
            how.stop_reason.as_deref(),
            how.report.as_deref(),
            error.map(|error| error.code.as_str()),
            error.map(|error| error.message.as_str()),
            error.is_some_and(|error| error.retryable),
            how.dead,
            how.progress.map(|progress| progress.done),
            how.progress.map(|progress| progress.total),
            how.progress.map(|progress| progress.loss),
        ],
    )?;
    let ended = Arc::new(rows::job(&row)?);
    // A sequence counts in the load only while its closing job is queued or running.
    if job.kind == Kind::Pair || job.ready.is_some() {
        let list = if job.state == State::Running {
            &mut effects.stopped
        } else {
            &mut effects.left
        };
        list.push(Arc::clone(&ended));
    }
    outbox::deliver(sql, &ended)?;
    outbox::notify(sql, &ended)?;
    effects.changed.push(Arc::clone(&ended));
    effects.events.push(Event::Ended(ended));
    fair_queue::release_followers(sql, effects, job)?;
    if let Some(parent) = job.parent {
        let text = format!(
            "UPDATE jobs SET pairs_left = pairs_left - 1 WHERE id = ?1 RETURNING {COLUMNS}"
        );
        let parent = rows::job(&sql.only(&text, values![parent])?)?;
        if parent.pairs_left == 0 {
            close_sequence(sql, effects, options, &parent)?;
        } else {
            effects.changed.push(Arc::new(parent));
        }
    }
    Ok(state)
}

/// Closes a sequence whose pairs have all ended. If one did not succeed, the sequence ends like the
/// first such pair. If all have succeeded, its closing job is queued, or it succeeds if it has
/// none.
fn close_sequence(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    sequence: &Job,
) -> Result<(), QueueError> {
    let pairs = rows::pairs(sql, sequence.id)?;
    let broken = pairs.iter().find(|pair| pair.state != State::Succeeded);
    let (state, error) = match broken {
        None if fair_queue::closes(sql, sequence.id)? => {
            fair_queue::ready_to_close(sql, effects, options, sequence)?;
            return Ok(());
        }
        None => (State::Succeeded, None),
        Some(_) if sequence.cancel_requested => (State::Cancelled, None),
        Some(pair) => {
            let back = if pair.backward { ", back in time" } else { "" };
            let error = pair.error.clone().map(|error| JobError {
                message: format!("pair {}{back}: {}", pair.index, error.message),
                ..error
            });
            (pair.state, error)
        }
    };
    let how = End {
        dead: broken.is_some_and(|pair| pair.dead),
        error,
        ..End::default()
    };
    end(sql, effects, options, sequence, state, &how)?;
    Ok(())
}

/// Cancels a job: a queued job ends at once, a running one through its worker.
pub(in crate::queue) fn cancel(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
) -> Result<Arc<Job>, QueueError> {
    let job = rows::lock_known(sql, id)?;
    if job.state.is_end() {
        return Ok(Arc::new(job));
    }
    let text = "UPDATE jobs SET cancel_requested = 1 WHERE id = ?1";
    sql.query(text, values![id])?;
    match job.state {
        // Before its closing job, a sequence runs only through its pairs.
        _ if job.pairs_left > 0 => {
            for pair in rows::lock_pairs(sql, id)? {
                if !pair.state.is_end() {
                    cancel(sql, effects, options, pair.id)?;
                }
            }
        }
        State::Queued => {
            end(
                sql,
                effects,
                options,
                &job,
                State::Cancelled,
                &End::default(),
            )?;
        }
        _ => effects.cancel.push((id, job.attempt)),
    }
    let job = Arc::new(rows::get(sql, id)?);
    effects.changed.push(Arc::clone(&job));
    Ok(job)
}

/// Requeues an ended job; of a sequence, the pairs that did not succeed and the closing job. A job
/// that has succeeded is requeued only if its result is `lost`.
pub(in crate::queue) fn requeue(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
    lost: bool,
) -> Result<Arc<Job>, QueueError> {
    let job = rows::lock_known(sql, id)?;
    if !job.state.is_end() || (job.state == State::Succeeded && !lost) {
        return Err(QueueError::NotTerminal(job.state));
    }
    if let Some(sequence) = job.parent {
        // Its closing job reads the results of all pairs.
        let sequence = rows::lock_known(sql, sequence)?;
        if sequence.ready.is_some() && !sequence.state.is_end() {
            return Err(QueueError::NotTerminal(sequence.state));
        }
    }
    let unfinished: Vec<Job> = match job.kind {
        Kind::Pair => Vec::new(),
        Kind::Sequence => rows::pairs(sql, id)?
            .into_iter()
            .filter(|pair| pair.state != State::Succeeded || pair.is_cut_short())
            .collect(),
    };
    let expires = sql.now().after(options.time_to_live);
    let text = format!(
        "UPDATE jobs SET state = 0, durable = 1, pairs_left = ?2, delayed = 0, failures = 0, \
         crashes = 0, delays = 0, \
         started = NULL, finished = NULL, deadline = NULL, expires = ?3, \
         due = CASE WHEN kind = 0 THEN ?3 END, stop_reason = NULL, report = NULL, \
         error_code = NULL, error_message = NULL, error_retryable = 0, dead = 0, \
         cancel_requested = 0, progress_done = NULL, \
         delivery = CASE WHEN result_uri IS NOT NULL THEN 0 END, virtual_start = ?4, virtual_finish = ?4 + cost, \
         ready = ?5 WHERE id = ?1 RETURNING {COLUMNS}"
    );
    // Like a new job, it is queued behind the jobs that its tenant has waiting now.
    let again = |job: &Job, left: usize| -> Result<Arc<Job>, QueueError> {
        let is_ready = job.kind == Kind::Pair && !fair_queue::is_held_back(sql, job.after)?;
        let tag = fair_queue::virtual_start(sql, &job.tenant, job.priority)?;
        let ready = is_ready.then(|| sql.now());
        let row = sql.only(&text, values![job.id, left as i64, expires, tag, ready])?;
        Ok(Arc::new(rows::job(&row)?))
    };
    let mut job = again(&job, unfinished.len())?;
    let mut queued = Vec::new();
    for pair in &unfinished {
        queued.push(again(pair, 0)?);
    }
    if job.kind == Kind::Sequence && unfinished.is_empty() {
        job = fair_queue::ready_to_close(sql, effects, options, &job)?;
        effects.events.push(Event::Requeued(Arc::clone(&job)));
    }
    if job.kind == Kind::Pair {
        if let Some(parent) = job.parent {
            let text = format!(
                "UPDATE jobs SET pairs_left = pairs_left + 1, finished = NULL, due = NULL, \
                 ready = NULL, state = CASE WHEN state = 1 THEN 1 ELSE 0 END, error_code = NULL, \
                 dead = 0, cancel_requested = 0, report = NULL, stop_reason = NULL, \
                 failures = 0, crashes = 0, delays = 0, progress_done = NULL, \
                 deadline = CASE WHEN finished IS NULL THEN deadline END, \
                 delivery = CASE WHEN finished IS NULL THEN delivery \
                 WHEN result_uri IS NOT NULL THEN 0 END \
                 WHERE id = ?1 RETURNING {COLUMNS}"
            );
            let parent = rows::job(&sql.only(&text, values![parent])?)?;
            effects.changed.push(Arc::new(parent));
        }
        queued.push(Arc::clone(&job));
    }
    for pair in queued {
        effects.events.push(Event::Requeued(Arc::clone(&pair)));
        effects.changed.push(Arc::clone(&pair));
        effects.entered.push(pair);
    }
    effects.changed.push(Arc::clone(&job));
    Ok(job)
}

/// Cancels an ephemeral job whose caller has disconnected.
pub(in crate::queue) fn abandon(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
) -> Result<(), QueueError> {
    match rows::lock(sql, id)? {
        Some(job) if !job.durable => cancel(sql, effects, options, id).map(drop),
        _ => Ok(()),
    }
}

/// Makes a job and its pairs durable.
pub(in crate::queue) fn make_durable(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
) -> Result<Arc<Job>, QueueError> {
    let job = rows::lock_known(sql, id)?;
    if !job.durable && job.cancel_requested {
        return Err(QueueError::GivenUp);
    }
    let text = "UPDATE jobs SET durable = 1, due = CASE WHEN state > 1 AND parent IS NULL \
                THEN ?2 ELSE due END WHERE id = ?1 OR parent = ?1";
    let until = sql.now().after(options.retention);
    sql.query(text, values![id, until])?;
    let job = Arc::new(rows::get(sql, id)?);
    effects.changed.push(Arc::clone(&job));
    Ok(job)
}
