//! The outbox: actions outside the database, promised by a commit and done after it.
//!
//! A row is written in the transaction that ends or removes a job, so that no crash loses it. A node
//! takes the rows that are due, and holds them for a while.

use std::sync::Arc;
use std::time::Duration;

use super::rows;
use super::rows::delivery_code;
use crate::clock::Timestamp;
use crate::job::{DeliveryState, Job, JobId, State, ended_notice};
use crate::queue::outgoing::{Action, Outgoing, Settled};
use crate::queue::sql::{Row, Sql, values};
use crate::queue::types::QueueError;

/// The statement that finds due rows. The query plan test also uses it.
pub(in crate::queue) const DUE: &str = "SELECT seq, job, url, body FROM outbox INDEXED BY outbox_due WHERE due <= ?1 ORDER BY due LIMIT ?2";

/// A delivery may take this many times as long as other actions.
const DELIVERY_HOLDS: u32 = 10;

/// The least delay of a notice whose job is still delivering its result.
const NOTICE_DELAY: Duration = Duration::from_millis(500);

/// How often due rows are looked for at once where those that were found are put off.
const LOOKS: u32 = 16;

/// The statement that finds when the last delivery of a job and of its pairs is due. The query plan test
/// also uses it.
pub(in crate::queue) const UNDELIVERED: &str = "SELECT max(due) FROM outbox INDEXED BY outbox_job \
    WHERE job IN (SELECT ?1 UNION ALL SELECT id FROM jobs INDEXED BY jobs_parent WHERE parent = ?1) \
    AND url IS NOT NULL AND body IS NULL";

/// The statement that makes the notices due that wait for a delivery of this job. The query plan test
/// also uses it.
pub(in crate::queue) const WAKE_NOTICES: &str = "UPDATE outbox INDEXED BY outbox_job SET due = ?2 \
    WHERE job IN (SELECT ?1 UNION ALL SELECT parent FROM jobs INDEXED BY jobs_id WHERE id = ?1 \
    AND parent IS NOT NULL) AND body IS NOT NULL AND attempts = 0";

/// Promises to remove the files of a job and of its pairs. Returns them.
pub(super) fn remove_files(sql: &dyn Sql, id: JobId) -> Result<Vec<JobId>, QueueError> {
    let text = "INSERT INTO outbox (job, due, attempts) SELECT id, ?2, 0 FROM jobs \
                INDEXED BY jobs_parent WHERE parent = ?1 RETURNING job";
    let rows = sql.query(text, values![id, sql.now()])?;
    insert(sql, id, None, None)?;
    let pairs = rows.iter().map(|row| row.get(0));
    pairs.chain([Ok(id)]).collect()
}

/// Promises to deliver the result of a job that has succeeded, if there is a place for it.
pub(super) fn deliver(sql: &dyn Sql, ended: &Job) -> Result<(), QueueError> {
    match &ended.delivery {
        Some(delivery) if ended.state == State::Succeeded => {
            insert(sql, ended.id, Some(&delivery.uri), None)
        }
        _ => Ok(()),
    }
}

/// Promises to tell the webhook of a job, if it has one, of its end.
pub(super) fn notify(sql: &dyn Sql, ended: &Job) -> Result<(), QueueError> {
    match &ended.webhook {
        None => Ok(()),
        Some(url) => insert(sql, ended.id, Some(url), Some(&ended_notice(ended))),
    }
}

fn insert(
    sql: &dyn Sql,
    id: JobId,
    url: Option<&str>,
    body: Option<&str>,
) -> Result<(), QueueError> {
    let text = "INSERT INTO outbox (job, due, attempts, url, body) VALUES (?1, ?2, 0, ?3, ?4)";
    sql.query(text, values![id, sql.now(), url, body])?;
    Ok(())
}

/// Whether a row is due.
pub(in crate::queue) fn has_due(sql: &dyn Sql) -> Result<bool, QueueError> {
    Ok(sql.first(DUE, values![sql.now(), 1_i64])?.is_some())
}

/// Takes up to `limit` due rows that no other node is taking, and makes them due again after `hold`.
pub(in crate::queue) fn take(
    sql: &dyn Sql,
    limit: u32,
    hold: Duration,
) -> Result<Vec<Outgoing>, QueueError> {
    let text = format!("{DUE} FOR UPDATE SKIP LOCKED");
    let mut taken = Vec::new();
    for _ in 0..LOOKS {
        let due = sql.query(&text, values![sql.now(), i64::from(limit)])?;
        for row in &due {
            taken.extend(take_row(sql, row, hold)?);
        }
        // Of those that were found all may be notices that wait. They are put off by now.
        if !taken.is_empty() || due.len() < limit as usize {
            break;
        }
    }
    Ok(taken)
}

/// Takes one row. `None` if there is nothing to do (any more), or not yet.
fn take_row(sql: &dyn Sql, row: &Row, hold: Duration) -> Result<Option<Outgoing>, QueueError> {
    let (number, job): (i64, JobId) = (row.get(0)?, row.get(1)?);
    let (url, body): (Option<String>, Option<String>) = (row.get(2)?, row.get(3)?);
    let (action, hold) = match (url, body) {
        (None, _) => (Action::RemoveFiles, hold),
        (Some(_), None) => match rows::find(sql, job)? {
            Some(job) if job.state == State::Succeeded => {
                (Action::Deliver(Arc::new(job)), hold * DELIVERY_HOLDS)
            }
            // It was removed, or is done again and then delivered by another row.
            _ => {
                sql.query("DELETE FROM outbox WHERE seq = ?1", values![number])?;
                return Ok(None);
            }
        },
        (Some(url), Some(body)) => match delivered_at(sql, job)? {
            None => (Action::Notify { url, body }, hold),
            // The end of the last delivery makes it due sooner.
            Some(at) => {
                let delay = sql.now().until(at).max(NOTICE_DELAY);
                put_off(sql, number, delay, 0)?;
                return Ok(None);
            }
        },
    };
    let text = "UPDATE outbox SET due = ?2, attempts = attempts + 1 WHERE seq = ?1 \
                RETURNING attempts";
    let row = sql.only(text, values![number, sql.now().after(hold)])?;
    Ok(Some(Outgoing {
        number,
        job,
        attempts: row.get(0)?,
        action,
    }))
}

/// Whether the result of a job, or one of its pairs', is still to be delivered.
pub(super) fn is_delivering(sql: &dyn Sql, job: JobId) -> Result<bool, QueueError> {
    Ok(delivered_at(sql, job)?.is_some())
}

/// When the result of a job, or the last result of its pairs, is due to be delivered. `None` if nothing
/// is to be delivered any more.
fn delivered_at(sql: &dyn Sql, job: JobId) -> Result<Option<Timestamp>, QueueError> {
    sql.only(UNDELIVERED, values![job])?.get(0)
}

/// Makes a row due after a delay, and does not count this many of its attempts.
fn put_off(sql: &dyn Sql, number: i64, delay: Duration, attempts: i64) -> Result<(), QueueError> {
    sql.query(
        "UPDATE outbox SET due = ?2, attempts = attempts - ?3 WHERE seq = ?1",
        values![number, sql.now().after(delay), attempts],
    )?;
    Ok(())
}

/// Removes the rows that are done or given up, and makes the others due after their delay.
pub(in crate::queue) fn settle(
    sql: &dyn Sql,
    actions: &[(i64, Settled)],
) -> Result<(), QueueError> {
    for (number, settled) in actions {
        match *settled {
            Settled::Done => remove(sql, *number, DeliveryState::Delivered)?,
            Settled::GivenUp => remove(sql, *number, DeliveryState::GivenUp)?,
            Settled::Again(delay) => put_off(sql, *number, delay, 0)?,
            Settled::NotTried(delay) => put_off(sql, *number, delay, 1)?,
        }
    }
    Ok(())
}

/// Removes a row. If it is a delivery, notes its state with the job, unless the job is done again
/// meanwhile.
fn remove(sql: &dyn Sql, number: i64, state: DeliveryState) -> Result<(), QueueError> {
    let text = "DELETE FROM outbox WHERE seq = ?1 RETURNING job, url, body";
    let Some(row) = sql.first(text, values![number])? else {
        return Ok(());
    };
    let (url, body): (Option<String>, Option<String>) = (row.get(1)?, row.get(2)?);
    if url.is_some() && body.is_none() {
        let text = "UPDATE jobs SET delivery = ?2 WHERE id = ?1 AND state = 2";
        let job: JobId = row.get(0)?;
        sql.query(text, values![job, delivery_code(state)])?;
        sql.query(WAKE_NOTICES, values![job, sql.now()])?;
    }
    Ok(())
}
