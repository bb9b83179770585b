//! Submission of jobs.

use std::sync::Arc;

use super::finish::make_durable;
use super::rows::{COLUMNS, delivery_code, device_code, kind_code, priority_code};
use super::{fair_queue, rows};
use crate::job::{DeliveryState, Job, JobId, Kind, State, Tenant, uri_of_pair};
use crate::queue::effects::Effects;
use crate::queue::sql::{Sql, values};
use crate::queue::types::{Event, PairOf, QueueError, QueueOptions, Submission, Submitted};

/// Accepts a job and, for a sequence, its pairs.
pub(in crate::queue) fn submit(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    submission: &Submission,
) -> Result<Submitted, QueueError> {
    if let Some(known) = known(sql, effects, options, submission)? {
        return Ok(Submitted::Known(known));
    }
    if !submission.durable {
        sql.check_node()?;
    }
    let is_held_back = fair_queue::is_held_back(sql, submission.after)?;
    let mut tag = fair_queue::virtual_start(sql, &submission.tenant, submission.priority)?;
    let of_pair = Place {
        parent: None,
        is_held_back,
        tag,
    };
    let job = Arc::new(insert(sql, options, submission, &of_pair)?);
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
                    labels: Vec::new(),
                    webhook: None,
                    result_uri: uri_of(submission, of),
                    ..submission.clone()
                };
                let place = Place {
                    parent: Some(job.id),
                    // The pair before was submitted a moment ago.
                    is_held_back: pair.after.is_some(),
                    tag,
                };
                let pair = Arc::new(insert(sql, options, &pair, &place)?);
                // Nothing of the tenant is queued behind the pair that was just inserted.
                tag += pair.cost_seconds;
                before = Some(pair.id);
                effects.events.push(Event::Submitted(Arc::clone(&pair)));
                effects.entered.push(pair);
            }
        }
    }
    effects.events.push(Event::Submitted(Arc::clone(&job)));
    Ok(Submitted::New(job))
}

/// The URI that the flow of a sequence's pair is delivered to.
fn uri_of(sequence: &Submission, pair: &PairOf) -> Option<String> {
    let uri = sequence.result_uri.as_deref().filter(|_| !pair.backward)?;
    uri_of_pair(uri, pair.index)
}

/// The job to which the idempotency key of a submission belongs, if it is the same submission.
fn known(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    submission: &Submission,
) -> Result<Option<Arc<Job>>, QueueError> {
    let Some(idempotency) = &submission.idempotency else {
        return Ok(None);
    };
    let tenant = submission.tenant.as_str();
    let text = "SELECT id, fingerprint, origin FROM jobs INDEXED BY jobs_key \
                WHERE tenant = ?1 AND idempotency_key = ?2";
    let Some(row) = sql.first(text, values![tenant, idempotency.key.as_str()])? else {
        return Ok(None);
    };
    let (id, fingerprint): (JobId, Vec<u8>) = (row.get(0)?, row.get(1)?);
    let Some(known) = rows::lock(sql, id)? else {
        return Ok(None);
    };
    let failed = known.state.is_end() && known.state != State::Succeeded;
    if (failed || known.cancel_requested) && !known.durable {
        // Its caller abandoned it, so the key is free for a new submission.
        let free = "UPDATE jobs SET idempotency_key = NULL WHERE id = ?1";
        sql.query(free, values![id])?;
        return Ok(None);
    }
    if fingerprint != idempotency.fingerprint {
        return Err(QueueError::KeyReused(id));
    }
    if !known.durable && row.get::<i64>(2)? != sql.node() {
        // Its caller came back at another node: the first one must not cancel it.
        return make_durable(sql, effects, options, id).map(Some);
    }
    Ok(Some(Arc::new(known)))
}

/// Inserts a job and deletes it again: exercises the writes of a submission.
pub(in crate::queue) fn probe(sql: &dyn Sql, options: &QueueOptions) -> Result<(), QueueError> {
    let submission = Submission::pair(Tenant::default());
    let place = Place {
        parent: None,
        is_held_back: false,
        tag: 0.0,
    };
    let job = insert(sql, options, &submission, &place)?;
    sql.query("DELETE FROM jobs WHERE id = ?1", values![job.id])?;
    Ok(())
}

/// Where a new job is queued.
struct Place {
    parent: Option<JobId>,
    /// Whether it waits for the end of the job that it follows.
    is_held_back: bool,
    /// Its start tag, if it is a pair.
    tag: f64,
}

/// Inserts one row.
fn insert(
    sql: &dyn Sql,
    options: &QueueOptions,
    submission: &Submission,
    place: &Place,
) -> Result<Job, QueueError> {
    let now = sql.now();
    let is_pair = submission.kind == Kind::Pair;
    let virtual_start = if is_pair { place.tag } else { 0.0 };
    let deadline = submission
        .deadline
        .map(|deadline| deadline.on_clock_ahead(sql.ahead_ms()));
    let expires = deadline.unwrap_or_else(|| now.after(options.time_to_live));
    let cost = match submission.kind {
        Kind::Pair => submission.cost_seconds,
        Kind::Sequence => submission.finalizer_seconds.unwrap_or(0.0),
    };
    let is_ready = is_pair && !place.is_held_back;
    let text = format!(
        "INSERT INTO jobs (id, tenant, kind, parent, pair_index, pairs, pairs_left, priority, \
         device, state, durable, delayed, attempt, failures, crashes, delays, cost, \
         virtual_start, virtual_finish, options, idempotency_key, fingerprint, created, deadline, \
         expires, due, error_retryable, dead, cancel_requested, backward, after, has_dependents, \
         ready, closes, sees_from, sees_to, origin, trace, webhook, result_uri, delivery) \
         VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?6, ?7, ?19, 0, ?8, 0, 0, 0, 0, 0, \
         ?9, ?10, ?11, ?12, ?13, ?14, ?15, ?16, ?17, ?18, 0, 0, 0, ?20, ?21, ?22, ?23, ?24, ?25, \
         ?26, ?27, ?28, ?29, ?30, ?31) RETURNING {COLUMNS}"
    );
    let idempotency = submission.idempotency.as_ref();
    // The URI of a sequence may be that of its pairs.
    let result_uri = submission.result_uri.as_deref();
    let result_uri = result_uri.filter(|uri| uri_of_pair(uri, 0).is_none());
    let row = sql.only(
        &text,
        values![
            submission.id,
            submission.tenant.as_str(),
            kind_code(submission.kind),
            place.parent,
            submission.pair.index,
            submission.pairs.len() as i64,
            priority_code(submission.priority),
            submission.durable,
            cost,
            virtual_start,
            virtual_start + cost,
            submission.options.as_str(),
            idempotency.map(|idempotency| idempotency.key.as_str()),
            idempotency.map(|idempotency| idempotency.fingerprint.as_slice()),
            now,
            deadline,
            expires,
            is_pair.then_some(expires),
            device_code(submission.device),
            submission.pair.backward,
            submission.after,
            submission.has_dependents,
            is_ready.then_some(now),
            submission.finalizer_seconds.is_some(),
            submission.pair.window[0],
            submission.pair.window[1],
            sql.node(),
            submission.trace.as_deref(),
            submission.webhook.as_deref(),
            result_uri,
            result_uri.map(|_| delivery_code(DeliveryState::Pending)),
        ],
    )?;
    for label in &submission.labels {
        sql.query(
            "INSERT INTO labels (owner, label, job) VALUES (?1, ?2, ?3)",
            values![submission.tenant.as_str(), label.as_str(), submission.id],
        )?;
    }
    rows::job(&row)
}
