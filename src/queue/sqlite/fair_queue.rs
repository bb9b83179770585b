//! Fair queueing by virtual time, and dependencies between jobs.
//!
//! A job that follows another one gets a provisional tag at submission, so that later jobs of its
//! tenant are behind it. It gets its final tag when it becomes ready, which counts as its arrival.
//! Independent of how jobs end.

use std::sync::Arc;

use rusqlite::{Connection, OptionalExtension, params};

use super::effects::Effects;
use super::rows;
use super::rows::{COLUMNS, DEVICES, device_code, priority_code};
use crate::clock::Timestamp;
use crate::job::{Job, JobId, Priority, Tenant};
use crate::queue::types::{QueueError, QueueOptions};

/// The start tag of a new job, by start-time fair queueing (Goyal et al. 1996). It is the largest
/// finish tag of the tenant's waiting or running jobs of this priority, but not less than the
/// current virtual time. Tags are seconds of predicted work, so tenants share devices by work and
/// not by number of jobs.
pub(super) fn virtual_start(
    connection: &Connection,
    tenant: &Tenant,
    priority: Priority,
) -> Result<f64, QueueError> {
    let served = virtual_now(connection, priority)?;
    let sql = "SELECT max(virtual_finish) FROM jobs INDEXED BY jobs_tail \
               WHERE state < 2 AND (kind = 0 OR ready IS NOT NULL) AND tenant = ?1 \
               AND priority = ?2";
    let own: Option<f64> = connection
        .prepare_cached(sql)?
        .query_row(params![tenant.as_str(), priority_code(priority)], |row| {
            row.get(0)
        })?;
    Ok(served.unwrap_or(0.0).max(own.unwrap_or(0.0)))
}

/// The virtual time of a priority: the largest start tag of the running jobs or, if there are none,
/// the smallest of the ready jobs. `None` if no job is running or ready.
pub(super) fn virtual_now(
    connection: &Connection,
    priority: Priority,
) -> Result<Option<f64>, QueueError> {
    let priority = priority_code(priority);
    let one = |sql: &str, parameters: &[&dyn rusqlite::ToSql]| -> Result<Option<f64>, QueueError> {
        let mut statement = connection.prepare_cached(sql)?;
        Ok(statement.query_row(parameters, |row| row.get(0))?)
    };
    let served = one(
        "SELECT max(virtual_start) FROM jobs INDEXED BY jobs_running \
         WHERE state = 1 AND ready IS NOT NULL AND priority = ?1",
        &[&priority],
    )?;
    if served.is_some() {
        return Ok(served);
    }
    let mut first: Option<f64> = None;
    for device in DEVICES {
        let ready = one(
            "SELECT min(virtual_start) FROM jobs INDEXED BY jobs_ready \
             WHERE state = 0 AND ready IS NOT NULL AND delayed = 0 AND device = ?1 \
             AND priority = ?2",
            &[&device_code(device), &priority],
        )?;
        first = first.into_iter().chain(ready).reduce(f64::min);
    }
    Ok(first)
}

/// Whether a job that follows `after` has to wait.
pub(super) fn is_held_back(
    connection: &Connection,
    after: Option<JobId>,
) -> Result<bool, QueueError> {
    let Some(after) = after else {
        return Ok(false);
    };
    let sql = "SELECT 1 FROM jobs INDEXED BY jobs_id WHERE id = ?1 AND state < 2";
    let mut statement = connection.prepare_cached(sql)?;
    let open = statement
        .query_row([after.as_bytes()], |_| Ok(()))
        .optional()?;
    Ok(open.is_some())
}

/// The statement that finds the followers of a job. The query plan test also uses it.
pub(super) const FOLLOWERS: &str = "SELECT id FROM jobs INDEXED BY jobs_after \
    WHERE after = ?1 AND after IS NOT NULL AND state < 2";

/// The followers of a job that have not ended.
pub(super) fn followers(connection: &Connection, id: JobId) -> Result<Vec<JobId>, QueueError> {
    let mut statement = connection.prepare_cached(FOLLOWERS)?;
    let rows = statement.query_map([id.as_bytes()], |row| row.get(0))?;
    let ids: Vec<[u8; 16]> = rows.collect::<rusqlite::Result<_>>()?;
    Ok(ids.into_iter().map(JobId::from_bytes).collect())
}

/// Makes the followers of a job ready, when it has ended or is about to be forgotten. Their start
/// tag is its finish tag, but not less than the virtual time, so a chain gets no more than its
/// share.
pub(super) fn release_followers(
    connection: &Connection,
    effects: &mut Effects,
    job: &Job,
) -> Result<(), QueueError> {
    let followers = followers(connection, job.id)?;
    if followers.is_empty() {
        return Ok(());
    }
    let sql = "SELECT virtual_finish FROM jobs INDEXED BY jobs_id WHERE id = ?1";
    let finish: f64 = connection
        .prepare_cached(sql)?
        .query_row([job.id.as_bytes()], |row| row.get(0))?;
    let sql = format!(
        "UPDATE jobs SET ready = ?2, virtual_start = ?3, virtual_finish = ?3 + cost \
         WHERE id = ?1 AND state = 0 AND ready IS NULL RETURNING {COLUMNS}"
    );
    for follower in followers {
        let served = virtual_now(connection, job.priority)?.unwrap_or(0.0);
        let now = Timestamp::now().as_millis();
        let parameters = params![follower.as_bytes(), now, served.max(finish)];
        let mut statement = connection.prepare_cached(&sql)?;
        let ready = statement.query_row(parameters, rows::job).optional()?;
        effects.changed.extend(ready.map(Arc::new));
    }
    Ok(())
}

/// Queues the closing job of a sequence whose pairs have all succeeded.
pub(super) fn ready_to_close(
    connection: &Connection,
    effects: &mut Effects,
    options: &QueueOptions,
    sequence: &Job,
) -> Result<Arc<Job>, QueueError> {
    let tag = virtual_start(connection, &sequence.tenant, sequence.priority)?;
    let now = Timestamp::now();
    // The deadline applies to the pairs only. The closing job waits for a device as jobs without a
    // deadline do.
    let expires = now.after(options.time_to_live).as_millis();
    let sql = format!(
        "UPDATE jobs SET state = 0, ready = ?2, expires = ?3, due = ?3, virtual_start = ?4, \
         virtual_finish = ?4 + cost WHERE id = ?1 RETURNING {COLUMNS}"
    );
    let mut statement = connection.prepare_cached(&sql)?;
    let parameters = params![sequence.id.as_bytes(), now.as_millis(), expires, tag];
    let sequence = Arc::new(statement.query_row(parameters, rows::job)?);
    effects.entered.push(Arc::clone(&sequence));
    effects.changed.push(Arc::clone(&sequence));
    Ok(sequence)
}

/// Whether a sequence has a closing job after its pairs.
pub(super) fn closes(connection: &Connection, id: JobId) -> Result<bool, QueueError> {
    let sql = "SELECT closes FROM jobs INDEXED BY jobs_id WHERE id = ?1";
    let mut statement = connection.prepare_cached(sql)?;
    Ok(statement.query_row([id.as_bytes()], |row| row.get(0))?)
}
