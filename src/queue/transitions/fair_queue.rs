//! Fair queueing by virtual time, and dependencies between jobs.
//!
//! A job that follows another one gets a provisional tag at submission, so that later jobs of its
//! tenant are behind it. It gets its final tag when it becomes ready, which counts as its arrival.
//! Independent of how jobs end.

use std::sync::Arc;

use super::rows;
use super::rows::{COLUMNS, DEVICES, device_code, priority_code};
use crate::job::{Job, JobId, Priority, Tenant};
use crate::queue::effects::Effects;
use crate::queue::sql::{Sql, Value, values};
use crate::queue::types::{QueueError, QueueOptions};

/// The statement that finds the last finish tag of a tenant's open jobs.
pub(in crate::queue) const LAST_OF_TENANT: &str = "SELECT max(virtual_finish) FROM jobs \
    INDEXED BY jobs_tail WHERE state < 2 AND (kind = 0 OR ready IS NOT NULL) AND tenant = ?1 \
    AND priority = ?2";

/// The statement that finds the first start tag of the ready jobs of one device requirement.
pub(in crate::queue) const FIRST_TAG: &str = "SELECT min(virtual_start) FROM jobs \
    INDEXED BY jobs_ready WHERE state = 0 AND ready IS NOT NULL AND delayed = 0 AND device = ?1 \
    AND priority = ?2";

/// The start tag of a new job, by start-time fair queueing (Goyal et al. 1996). It is the largest
/// finish tag of the tenant's waiting or running jobs of this priority, but not less than the
/// current virtual time. Tags are seconds of predicted work, so tenants share devices by work and
/// not by number of jobs.
///
/// Other transactions that give tags to this tenant's jobs wait until the commit. A transaction
/// that also locks rows must have done so before.
pub(super) fn virtual_start(
    sql: &dyn Sql,
    tenant: &Tenant,
    priority: Priority,
) -> Result<f64, QueueError> {
    sql.lock_share(tenant, priority)?;
    let served = virtual_now(sql, priority)?;
    let own = number(
        sql,
        LAST_OF_TENANT,
        values![tenant.as_str(), priority_code(priority)],
    )?;
    Ok(served.unwrap_or(0.0).max(own.unwrap_or(0.0)))
}

/// The virtual time of a priority: the largest start tag of the running jobs or, if there are none,
/// the smallest of the ready jobs. `None` if no job is running or ready.
pub(super) fn virtual_now(sql: &dyn Sql, priority: Priority) -> Result<Option<f64>, QueueError> {
    let priority = priority_code(priority);
    let served = number(
        sql,
        "SELECT max(virtual_start) FROM jobs INDEXED BY jobs_running \
         WHERE state = 1 AND ready IS NOT NULL AND priority = ?1",
        values![priority],
    )?;
    if served.is_some() {
        return Ok(served);
    }
    let mut first: Option<f64> = None;
    for device in DEVICES {
        let ready = number(sql, FIRST_TAG, values![device_code(device), priority])?;
        first = first.into_iter().chain(ready).reduce(f64::min);
    }
    Ok(first)
}

/// The number that a statement finds; `None` if it finds none.
fn number(sql: &dyn Sql, text: &str, parameters: &[Value]) -> Result<Option<f64>, QueueError> {
    sql.only(text, parameters)?.get(0)
}

/// Whether a job that follows `after` has to wait. If so, that job does not end before the commit.
pub(super) fn is_held_back(sql: &dyn Sql, after: Option<JobId>) -> Result<bool, QueueError> {
    let Some(after) = after else {
        return Ok(false);
    };
    let text = "SELECT id FROM jobs INDEXED BY jobs_id WHERE id = ?1 AND state < 2 FOR SHARE";
    Ok(sql.first(text, values![after])?.is_some())
}

/// The statement that finds the followers of a job. The query plan test also uses it.
pub(in crate::queue) const FOLLOWERS: &str = "SELECT id FROM jobs INDEXED BY jobs_after \
    WHERE after = ?1 AND after IS NOT NULL AND state < 2";

/// The followers of a job that have not ended.
pub(super) fn followers(sql: &dyn Sql, id: JobId) -> Result<Vec<JobId>, QueueError> {
    let rows = sql.query(FOLLOWERS, values![id])?;
    rows.iter().map(|row| row.get(0)).collect()
}

/// Makes the followers of a job ready, when it has ended or is about to be deleted. Their start
/// tag is its finish tag, but not less than the virtual time, so a chain gets no more than its
/// share.
pub(super) fn release_followers(
    sql: &dyn Sql,
    effects: &mut Effects,
    job: &Job,
) -> Result<(), QueueError> {
    let followers = followers(sql, job.id)?;
    if followers.is_empty() {
        return Ok(());
    }
    let text = "SELECT virtual_finish FROM jobs INDEXED BY jobs_id WHERE id = ?1";
    let finish: f64 = sql.only(text, values![job.id])?.get(0)?;
    let text = format!(
        "UPDATE jobs SET ready = ?2, virtual_start = ?3, virtual_finish = ?3 + cost \
         WHERE id = ?1 AND state = 0 AND ready IS NULL RETURNING {COLUMNS}"
    );
    for follower in followers {
        let served = virtual_now(sql, job.priority)?.unwrap_or(0.0);
        let parameters = values![follower, sql.now(), served.max(finish)];
        if let Some(ready) = sql.first(&text, parameters)? {
            effects.changed.push(Arc::new(rows::job(&ready)?));
        }
    }
    Ok(())
}

/// Queues the closing job of a sequence whose pairs have all succeeded.
pub(super) fn ready_to_close(
    sql: &dyn Sql,
    effects: &mut Effects,
    options: &QueueOptions,
    sequence: &Job,
) -> Result<Arc<Job>, QueueError> {
    let tag = virtual_start(sql, &sequence.tenant, sequence.priority)?;
    let now = sql.now();
    // The deadline applies to the pairs only. The closing job waits for a device as jobs without a
    // deadline do.
    let expires = now.after(options.time_to_live);
    let text = format!(
        "UPDATE jobs SET state = 0, ready = ?2, expires = ?3, due = ?3, virtual_start = ?4, \
         virtual_finish = ?4 + cost WHERE id = ?1 RETURNING {COLUMNS}"
    );
    let row = sql.only(&text, values![sequence.id, now, expires, tag])?;
    let sequence = Arc::new(rows::job(&row)?);
    effects.entered.push(Arc::clone(&sequence));
    effects.changed.push(Arc::clone(&sequence));
    Ok(sequence)
}

/// Whether a sequence has a closing job after its pairs.
pub(super) fn closes(sql: &dyn Sql, id: JobId) -> Result<bool, QueueError> {
    let text = "SELECT closes FROM jobs INDEXED BY jobs_id WHERE id = ?1";
    sql.only(text, values![id])?.get(0)
}
