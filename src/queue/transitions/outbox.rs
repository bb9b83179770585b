//! The outbox: actions outside the database, promised by a commit and done after it.
//!
//! A row is written in the transaction that ends or removes a job, so that no crash loses it. A node
//! takes the rows that are due, and holds them for a while.

use std::time::Duration;

use crate::job::{Job, JobId, ended_notice};
use crate::queue::outgoing::{Action, Outgoing, Settled};
use crate::queue::sql::{Row, Sql, values};
use crate::queue::types::QueueError;

/// The statement that finds due rows. The query plan test also uses it.
pub(in crate::queue) const DUE: &str =
    "SELECT seq FROM outbox INDEXED BY outbox_due WHERE due <= ?1 ORDER BY due LIMIT ?2";

/// Promises to remove the files of a job.
pub(super) fn remove_files(sql: &dyn Sql, id: JobId) -> Result<(), QueueError> {
    insert(sql, id, None, None)
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
    let now = sql.now();
    let due = sql.query(
        &format!("{DUE} FOR UPDATE SKIP LOCKED"),
        values![now, i64::from(limit)],
    )?;
    let text = "UPDATE outbox SET due = ?2, attempts = attempts + 1 WHERE seq = ?1 \
                RETURNING seq, job, attempts, url, body";
    let again = now.after(hold);
    due.iter()
        .map(|row| outgoing(&sql.only(text, values![row.get::<i64>(0)?, again])?))
        .collect()
}

fn outgoing(row: &Row) -> Result<Outgoing, QueueError> {
    Ok(Outgoing {
        number: row.get(0)?,
        job: row.get(1)?,
        attempts: row.get(2)?,
        action: match row.get(3)? {
            None => Action::RemoveFiles,
            Some(url) => Action::Notify {
                url,
                body: row.get(4)?,
            },
        },
    })
}

/// Removes the rows that are done, and makes the others due after their delay.
pub(in crate::queue) fn settle(
    sql: &dyn Sql,
    actions: &[(i64, Settled)],
) -> Result<(), QueueError> {
    for (number, settled) in actions {
        let (delay, tries) = match *settled {
            Settled::Done => {
                sql.query("DELETE FROM outbox WHERE seq = ?1", values![*number])?;
                continue;
            }
            Settled::Again(delay) => (delay, 0),
            Settled::NotTried(delay) => (delay, 1),
        };
        sql.query(
            "UPDATE outbox SET due = ?2, attempts = attempts - ?3 WHERE seq = ?1",
            values![*number, sql.now().after(delay), tries],
        )?;
    }
    Ok(())
}
