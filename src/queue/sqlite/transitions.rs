//! Every change of a job's state, each a few statements inside the writer's transaction.
//!
//! What must follow a commit (news, counts, wake-ups) is gathered in [`Effects`]; nothing is told
//! before it is stored.

use std::sync::Arc;
use std::time::Duration;

use rusqlite::{Connection, OptionalExtension, params};

use super::rows::{self, COLUMNS, kind_code, priority_code, state_code};
use crate::clock::Timestamp;
use crate::job::{Job, JobError, JobId, JobProgress, Kind, State};
use crate::queue::{Committed, Event, Outcome, QueueError, QueueOptions, Submission, Submitted};

/// What follows a commit.
#[derive(Debug, Default)]
pub(super) struct Effects {
    /// Jobs that entered the queue.
    pub(super) entered: Vec<Arc<Job>>,
    /// Jobs that left the queue, for a worker or for good.
    pub(super) left: Vec<Arc<Job>>,
    /// Jobs that a worker has now.
    pub(super) started: Vec<Arc<Job>>,
    /// Jobs that no worker has any more.
    pub(super) stopped: Vec<Arc<Job>>,
    /// Jobs whose worker should stop: their end was asked for.
    pub(super) cancel: Vec<JobId>,
    /// Jobs that have changed in any way.
    pub(super) changed: Vec<Arc<Job>>,
    /// What metrics and the cleaner hear of.
    pub(super) events: Vec<Event>,
}

impl Effects {
    pub(super) fn merge(&mut self, other: Self) {
        self.entered.extend(other.entered);
        self.left.extend(other.left);
        self.started.extend(other.started);
        self.stopped.extend(other.stopped);
        self.cancel.extend(other.cancel);
        self.changed.extend(other.changed);
        self.events.extend(other.events);
    }
}

/// Accepts a job and, for a sequence, its pairs.
pub(super) fn submit(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    submission: &Submission,
) -> Result<Submitted, QueueError> {
    if let Some(idempotency) = &submission.idempotency {
        let sql = "SELECT id, fingerprint FROM jobs INDEXED BY jobs_key \
                   WHERE tenant = ?1 AND idempotency_key = ?2";
        let mut statement = connection.prepare_cached(sql)?;
        let known: Option<([u8; 16], Vec<u8>)> = statement
            .query_row(
                params![submission.tenant.as_str(), idempotency.key],
                |row| Ok((row.get(0)?, row.get(1)?)),
            )
            .optional()?;
        if let Some((id, fingerprint)) = known {
            let id = JobId::from_bytes(id);
            if fingerprint != idempotency.fingerprint {
                return Err(QueueError::KeyReused(id));
            }
            return Ok(Submitted::Known(Arc::new(rows::get(connection, id)?)));
        }
    }
    let job = Arc::new(insert(connection, options, submission, None)?);
    match submission.kind {
        Kind::Pair => effects.entered.push(Arc::clone(&job)),
        Kind::Sequence => {
            for place in 0..submission.pairs {
                let pair = Submission {
                    id: JobId::fresh(),
                    kind: Kind::Pair,
                    idempotency: None,
                    ..submission.clone()
                };
                let pair = Arc::new(insert(connection, options, &pair, Some((job.id, place)))?);
                effects.events.push(Event::Submitted(Arc::clone(&pair)));
                effects.entered.push(pair);
            }
        }
    }
    effects.events.push(Event::Submitted(Arc::clone(&job)));
    Ok(Submitted::New(job))
}

fn insert(
    connection: &Connection,
    options: &QueueOptions,
    submission: &Submission,
    place: Option<(JobId, u32)>,
) -> Result<Job, QueueError> {
    let now = Timestamp::now();
    let is_pair = submission.kind == Kind::Pair;
    let virtual_start = if is_pair {
        virtual_start(connection, submission)?
    } else {
        0.0
    };
    let expires = submission
        .deadline
        .unwrap_or_else(|| now.after(options.time_to_live));
    let pairs = if is_pair { 0 } else { submission.pairs };
    let sql = format!(
        "INSERT INTO jobs (id, tenant, kind, parent, place, pairs, pairs_left, priority, state, \
         durable, delayed, attempt, failures, crashes, cost, virtual_start, virtual_finish, \
         options, idempotency_key, fingerprint, created, deadline, expires, due, error_retryable, \
         dead, cancel_requested) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?6, ?7, 0, ?8, 0, 0, 0, 0, ?9, \
         ?10, ?11, ?12, ?13, ?14, ?15, ?16, ?17, ?18, 0, 0, 0) RETURNING {COLUMNS}"
    );
    let mut statement = connection.prepare_cached(&sql)?;
    let idempotency = submission.idempotency.as_ref();
    let job = statement.query_row(
        params![
            submission.id.as_bytes(),
            submission.tenant.as_str(),
            kind_code(submission.kind),
            place.map(|(parent, _)| *parent.as_bytes()),
            place.map_or(0, |(_, place)| place),
            pairs,
            priority_code(submission.priority),
            submission.durable,
            submission.cost_seconds,
            virtual_start,
            virtual_start + submission.cost_seconds,
            submission.options,
            idempotency.map(|idempotency| idempotency.key.as_str()),
            idempotency.map(|idempotency| idempotency.fingerprint.as_slice()),
            now.as_millis(),
            submission.deadline.map(Timestamp::as_millis),
            expires.as_millis(),
            is_pair.then_some(expires.as_millis()),
        ],
        rows::job,
    )?;
    Ok(job)
}

/// Start-time fair queueing (Goyal et al. 1996): a job's tag is where its tenant's last waiting or
/// running job ends, but never before what is being served now. Tags are seconds of predicted
/// work, so tenants share devices by work, not by number of jobs.
fn virtual_start(connection: &Connection, submission: &Submission) -> Result<f64, QueueError> {
    let priority = priority_code(submission.priority);
    let one = |sql: &str, parameters: &[&dyn rusqlite::ToSql]| -> Result<Option<f64>, QueueError> {
        let mut statement = connection.prepare_cached(sql)?;
        Ok(statement.query_row(parameters, |row| row.get(0))?)
    };
    let served = one(
        "SELECT max(virtual_start) FROM jobs INDEXED BY jobs_running \
         WHERE state = 1 AND kind = 0 AND priority = ?1",
        &[&priority],
    )?;
    let served = match served {
        Some(served) => Some(served),
        None => one(
            "SELECT min(virtual_start) FROM jobs INDEXED BY jobs_ready \
             WHERE state = 0 AND kind = 0 AND delayed = 0 AND priority = ?1",
            &[&priority],
        )?,
    };
    let own = one(
        "SELECT max(virtual_finish) FROM jobs INDEXED BY jobs_tail \
         WHERE state < 2 AND kind = 0 AND tenant = ?1 AND priority = ?2",
        &[&submission.tenant.as_str(), &priority],
    )?;
    Ok(served.unwrap_or(0.0).max(own.unwrap_or(0.0)))
}

/// The statement that takes the next job; the test of the plan reads it too.
pub(super) fn claim_sql() -> String {
    format!(
        "UPDATE jobs SET state = 1, attempt = attempt + 1, worker = ?1, due = ?2, \
         started = coalesce(started, ?3) WHERE seq = (SELECT seq FROM jobs INDEXED BY jobs_ready \
         WHERE state = 0 AND kind = 0 AND delayed = 0 \
         ORDER BY priority DESC, virtual_start, seq LIMIT 1) RETURNING {COLUMNS}"
    )
}

/// Takes the next job for `worker`.
pub(super) fn claim(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    worker: &str,
) -> Result<Option<Arc<Job>>, QueueError> {
    let now = Timestamp::now();
    let mut statement = connection.prepare_cached(&claim_sql())?;
    let until = now.after(options.lease).as_millis();
    let job = statement
        .query_row(params![worker, until, now.as_millis()], rows::job)
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

/// Prolongs a lease and notes progress; nothing where the lease is lost.
pub(super) fn beat(
    connection: &Connection,
    options: &QueueOptions,
    id: JobId,
    attempt: u32,
    progress: Option<JobProgress>,
) -> Result<(), QueueError> {
    let sql = "UPDATE jobs SET due = ?3, iteration = coalesce(?4, iteration), \
               max_iterations = coalesce(?5, max_iterations), loss = coalesce(?6, loss) \
               WHERE id = ?1 AND attempt = ?2 AND state = 1";
    connection.prepare_cached(sql)?.execute(params![
        id.as_bytes(),
        attempt,
        Timestamp::now().after(options.lease).as_millis(),
        progress.map(|progress| progress.iteration),
        progress.map(|progress| progress.max_iterations),
        progress.map(|progress| progress.loss),
    ])?;
    Ok(())
}

/// Forgets the crashes before a snapshot.
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

/// Ends an attempt, if it is the one that holds the job.
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
    // What comes after its end was asked for is not wanted any more.
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
        } => {
            let how = End {
                stop_reason: Some(stop_reason),
                report: Some(report),
                ..End::default()
            };
            end(connection, effects, options, &job, State::Succeeded, &how)?
        }
        Outcome::Released => requeue_running(connection, effects, &job, Duration::ZERO)?,
        Outcome::Failed(error) => fail(connection, effects, options, &job, error)?,
    };
    Ok(Committed::Yes(state))
}

/// One failure more: another attempt after a while, or the end.
pub(super) fn fail(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    error: JobError,
) -> Result<State, QueueError> {
    let sql = "UPDATE jobs SET failures = failures + 1 WHERE id = ?1 RETURNING failures";
    let failures: u32 = connection
        .prepare_cached(sql)?
        .query_row([job.id.as_bytes()], |row| row.get(0))?;
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

/// Puts a running job back where it was in the queue; its fence stays with the lost attempt.
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

/// With what a job ends.
#[derive(Debug, Default)]
pub(super) struct End {
    pub(super) stop_reason: Option<String>,
    pub(super) report: Option<String>,
    pub(super) error: Option<JobError>,
    pub(super) dead: bool,
}

/// Ends a job that is queued or running, and its sequence with its last pair.
pub(super) fn end(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    job: &Job,
    state: State,
    how: &End,
) -> Result<State, QueueError> {
    let now = Timestamp::now();
    let kept = if job.durable {
        options.retention
    } else {
        options.answered_retention
    };
    // A pair goes when its sequence goes.
    let forget = job.parent.is_none().then(|| now.after(kept).as_millis());
    let sql = format!(
        "UPDATE jobs SET state = ?2, finished = ?3, due = ?4, stop_reason = ?5, report = ?6, \
         error_code = ?7, error_message = ?8, error_retryable = ?9, dead = ?10, worker = NULL, \
         delayed = 0 WHERE id = ?1 RETURNING {COLUMNS}"
    );
    let mut statement = connection.prepare_cached(&sql)?;
    let error = how.error.as_ref();
    let ended = Arc::new(statement.query_row(
        params![
            job.id.as_bytes(),
            state_code(state),
            now.as_millis(),
            forget,
            how.stop_reason,
            how.report,
            error.map(|error| error.code.as_str()),
            error.map(|error| error.message.as_str()),
            error.is_some_and(|error| error.retryable),
            how.dead,
        ],
        rows::job,
    )?);
    if job.kind == Kind::Pair {
        let place = if job.state == State::Running {
            &mut effects.stopped
        } else {
            &mut effects.left
        };
        place.push(Arc::clone(&ended));
    }
    effects.changed.push(Arc::clone(&ended));
    effects.events.push(Event::Ended(ended));
    if let Some(parent) = job.parent {
        let sql = format!(
            "UPDATE jobs SET pairs_left = pairs_left - 1 WHERE id = ?1 RETURNING {COLUMNS}"
        );
        let mut statement = connection.prepare_cached(&sql)?;
        let parent = statement.query_row([parent.as_bytes()], rows::job)?;
        if parent.pairs_left == 0 {
            end_sequence(connection, effects, options, &parent)?;
        } else {
            effects.changed.push(Arc::new(parent));
        }
    }
    Ok(state)
}

/// Ends a sequence whose pairs have all ended: as its first pair that did not succeed.
fn end_sequence(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    sequence: &Job,
) -> Result<(), QueueError> {
    let pairs = rows::pairs(connection, sequence.id)?;
    let broken = pairs.iter().find(|pair| pair.state != State::Succeeded);
    let (state, error) = match broken {
        None => (State::Succeeded, None),
        Some(_) if sequence.cancel_requested => (State::Cancelled, None),
        Some(pair) => {
            let error = pair.error.clone().map(|error| JobError {
                message: format!("pair {}: {}", pair.place, error.message),
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
    end(connection, effects, options, sequence, state, &how)?;
    Ok(())
}

/// Asks for a job's end: at once where it waits, through its worker where it runs.
pub(super) fn cancel(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
) -> Result<Arc<Job>, QueueError> {
    let job = rows::get(connection, id)?;
    if job.state.is_end() {
        return Ok(Arc::new(job));
    }
    let sql = "UPDATE jobs SET cancel_requested = 1 WHERE id = ?1";
    connection.prepare_cached(sql)?.execute([id.as_bytes()])?;
    match job.kind {
        Kind::Sequence => {
            for pair in rows::pairs(connection, id)? {
                if !pair.state.is_end() {
                    cancel(connection, effects, options, pair.id)?;
                }
            }
        }
        Kind::Pair if job.state == State::Queued => {
            end(
                connection,
                effects,
                options,
                &job,
                State::Cancelled,
                &End::default(),
            )?;
        }
        Kind::Pair => effects.cancel.push(id),
    }
    let job = Arc::new(rows::get(connection, id)?);
    effects.changed.push(Arc::clone(&job));
    Ok(job)
}

/// Queues an ended job again; of a sequence, the pairs that did not succeed.
pub(super) fn requeue(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    id: JobId,
) -> Result<Arc<Job>, QueueError> {
    let job = rows::get(connection, id)?;
    if !job.state.is_end() {
        return Err(QueueError::NotEnded(job.state));
    }
    let broken: Vec<Job> = match job.kind {
        Kind::Pair => Vec::new(),
        Kind::Sequence => rows::pairs(connection, id)?
            .into_iter()
            .filter(|pair| pair.state != State::Succeeded)
            .collect(),
    };
    let expires = Timestamp::now().after(options.time_to_live).as_millis();
    let sql = format!(
        "UPDATE jobs SET state = 0, pairs_left = ?2, delayed = 0, failures = 0, crashes = 0, \
         started = NULL, finished = NULL, deadline = NULL, expires = ?3, \
         due = CASE WHEN kind = 0 THEN ?3 END, stop_reason = NULL, report = NULL, \
         error_code = NULL, error_message = NULL, error_retryable = 0, dead = 0, \
         cancel_requested = 0, iteration = NULL WHERE id = ?1 RETURNING {COLUMNS}"
    );
    let again = |id: JobId, left: usize| -> Result<Arc<Job>, QueueError> {
        let mut statement = connection.prepare_cached(&sql)?;
        let parameters = params![id.as_bytes(), left as i64, expires];
        Ok(Arc::new(statement.query_row(parameters, rows::job)?))
    };
    let job = again(id, broken.len())?;
    let mut queued = Vec::new();
    for pair in &broken {
        queued.push(again(pair.id, 0)?);
    }
    if job.kind == Kind::Pair {
        if let Some(parent) = job.parent {
            let sql = format!(
                "UPDATE jobs SET pairs_left = pairs_left + 1, state = 0, finished = NULL, \
                 due = NULL, error_code = NULL WHERE id = ?1 RETURNING {COLUMNS}"
            );
            let mut statement = connection.prepare_cached(&sql)?;
            let parent = statement.query_row([parent.as_bytes()], rows::job)?;
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
