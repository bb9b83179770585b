//! Submission of jobs.
//!
//! Every state change of a job is a few statements inside the writer's transaction: here, in
//! `fair_queue.rs`, in `leases.rs`, in `finish.rs` and in `expiry.rs`. Its notifications, counts
//! and wake-ups are collected in [`Effects`] and applied only after the commit.

use std::sync::Arc;

use rusqlite::{Connection, OptionalExtension, params};

use super::effects::Effects;
use super::rows::{COLUMNS, device_code, kind_code, priority_code};
use super::{fair_queue, rows};
use crate::clock::Timestamp;
use crate::job::{Job, JobId, Kind, State, Tenant};
use crate::queue::types::{Event, QueueError, QueueOptions, Submission, Submitted};

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
            let known = rows::get(connection, id)?;
            let failed = known.state.is_end() && known.state != State::Succeeded;
            if (failed || known.cancel_requested) && !known.durable {
                // Its caller abandoned it, so the key is free for a new submission.
                let sql = "UPDATE jobs SET idempotency_key = NULL WHERE id = ?1";
                connection.prepare_cached(sql)?.execute([id.as_bytes()])?;
            } else if fingerprint != idempotency.fingerprint {
                return Err(QueueError::KeyReused(id));
            } else {
                return Ok(Submitted::Known(Arc::new(known)));
            }
        }
    }
    let job = Arc::new(insert(connection, options, submission, None)?);
    match submission.kind {
        Kind::Pair => effects.entered.push(Arc::clone(&job)),
        Kind::Sequence => {
            let mut before = None;
            for (turn, of) in submission.pairs.iter().enumerate() {
                let next = submission.pairs.get(turn + 1);
                let pair = Submission {
                    id: JobId::fresh(),
                    kind: Kind::Pair,
                    pair: *of,
                    pairs: Vec::new(),
                    finalizer_seconds: None,
                    after: before.filter(|_| of.chained),
                    has_dependents: next.is_some_and(|next| next.chained),
                    idempotency: None,
                    ..submission.clone()
                };
                let pair = Arc::new(insert(connection, options, &pair, Some(job.id))?);
                before = Some(pair.id);
                effects.events.push(Event::Submitted(Arc::clone(&pair)));
                effects.entered.push(pair);
            }
        }
    }
    effects.events.push(Event::Submitted(Arc::clone(&job)));
    Ok(Submitted::New(job))
}

/// Inserts a job and deletes it again: exercises the writes of a submission.
pub(super) fn probe(connection: &Connection, options: &QueueOptions) -> Result<(), QueueError> {
    let submission = Submission::pair(Tenant::default());
    let job = insert(connection, options, &submission, None)?;
    let sql = "DELETE FROM jobs WHERE id = ?1";
    connection
        .prepare_cached(sql)?
        .execute([job.id.as_bytes()])?;
    Ok(())
}

/// Inserts one row.
fn insert(
    connection: &Connection,
    options: &QueueOptions,
    submission: &Submission,
    parent: Option<JobId>,
) -> Result<Job, QueueError> {
    let now = Timestamp::now();
    let is_pair = submission.kind == Kind::Pair;
    let virtual_start = if is_pair {
        fair_queue::virtual_start(connection, &submission.tenant, submission.priority)?
    } else {
        0.0
    };
    let expires = submission
        .deadline
        .unwrap_or_else(|| now.after(options.time_to_live));
    let cost = match submission.kind {
        Kind::Pair => submission.cost_seconds,
        Kind::Sequence => submission.finalizer_seconds.unwrap_or(0.0),
    };
    let is_ready = is_pair && !fair_queue::is_held_back(connection, submission.after)?;
    let sql = format!(
        "INSERT INTO jobs (id, tenant, kind, parent, pair_index, pairs, pairs_left, priority, \
         device, state, durable, delayed, attempt, failures, crashes, delays, cost, virtual_start, virtual_finish, \
         options, idempotency_key, fingerprint, created, deadline, expires, due, error_retryable, \
         dead, cancel_requested, backward, after, has_dependents, ready, closes, sees_from, sees_to) \
         VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?6, ?7, ?19, 0, ?8, 0, 0, 0, 0, 0, \
         ?9, ?10, ?11, ?12, ?13, ?14, ?15, ?16, ?17, ?18, 0, 0, 0, ?20, ?21, ?22, ?23, ?24, ?25, ?26) \
         RETURNING {COLUMNS}"
    );
    let mut statement = connection.prepare_cached(&sql)?;
    let idempotency = submission.idempotency.as_ref();
    let job = statement.query_row(
        params![
            submission.id.as_bytes(),
            submission.tenant.as_str(),
            kind_code(submission.kind),
            parent.map(|parent| *parent.as_bytes()),
            submission.pair.index,
            submission.pairs.len() as i64,
            priority_code(submission.priority),
            submission.durable,
            cost,
            virtual_start,
            virtual_start + cost,
            submission.options,
            idempotency.map(|idempotency| idempotency.key.as_str()),
            idempotency.map(|idempotency| idempotency.fingerprint.as_slice()),
            now.as_millis(),
            submission.deadline.map(Timestamp::as_millis),
            expires.as_millis(),
            is_pair.then_some(expires.as_millis()),
            device_code(submission.device),
            submission.pair.backward,
            submission.after.map(|after| *after.as_bytes()),
            submission.has_dependents,
            is_ready.then_some(now.as_millis()),
            submission.finalizer_seconds.is_some(),
            submission.pair.window[0],
            submission.pair.window[1],
        ],
        rows::job,
    )?;
    Ok(job)
}
