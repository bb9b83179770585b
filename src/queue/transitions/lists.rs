//! Lists and counts of jobs.

use std::collections::HashMap;
use std::sync::Arc;

use super::rows;
use super::rows::{COLUMNS, DEVICES, state_code};
use crate::job::{Job, JobId, Priority, State};
use crate::queue::backlog::{Backlog, BacklogKey, Load};
use crate::queue::sql::{Row, Sql, Value, values};
use crate::queue::types::{Filter, QueueError};

/// Maximum number of rows in one list.
const MAX_LISTED: u32 = 1000;

/// The jobs that a filter selects, latest first.
pub(in crate::queue) fn list(sql: &dyn Sql, filter: &Filter) -> Result<Vec<Arc<Job>>, QueueError> {
    let before = filter.before.map_or([0xff; 16], |id| *id.as_bytes());
    let limit = filter.limit.min(MAX_LISTED);
    let mut parameters = values![filter.tenant.as_str(), before.as_slice(), limit].to_vec();
    parameters.extend(filter.state.map(|state| Value::Int(state_code(state))));
    parameters.extend(filter.label.as_deref().map(Value::from));
    let rows = sql.query(&statement(filter), &parameters)?;
    rows.iter()
        .map(|row| rows::job(row).map(Arc::new))
        .collect()
}

/// The statement of a list. Its parameters are the tenant, the id before which jobs are listed, the
/// limit and, where the filter has them, the state and the label.
pub(in crate::queue) fn statement(filter: &Filter) -> String {
    let (index, in_state) = match filter.state {
        None => ("jobs_list", ""),
        Some(_) => ("jobs_list_by_state", "AND state = ?4"),
    };
    match filter.label {
        None => format!(
            "SELECT {COLUMNS} FROM jobs INDEXED BY {index} WHERE parent IS NULL \
             AND tenant = ?1 AND id < ?2 {in_state} ORDER BY id DESC LIMIT ?3"
        ),
        Some(_) => format!(
            "SELECT {COLUMNS} FROM labels JOIN jobs INDEXED BY jobs_id ON jobs.id = labels.job \
             WHERE owner = ?1 AND job < ?2 AND label = ?{} {in_state} ORDER BY job DESC LIMIT ?3",
            4 + usize::from(filter.state.is_some())
        ),
    }
}

/// The ids in this list that belong to jobs, in the same order.
pub(in crate::queue) fn known(sql: &dyn Sql, ids: &[JobId]) -> Result<Vec<JobId>, QueueError> {
    let found = find_all(sql, ids)?;
    let known = ids.iter().copied().filter(|id| found.contains_key(id));
    Ok(known.collect())
}

/// The jobs with these ids.
pub(in crate::queue) fn find_all(
    sql: &dyn Sql,
    ids: &[JobId],
) -> Result<HashMap<JobId, Arc<Job>>, QueueError> {
    // Each id is a parameter.
    const AT_ONCE: usize = 64;
    let mut found = HashMap::new();
    for ids in ids.chunks(AT_ONCE) {
        let places: Vec<_> = (1..=ids.len()).map(|place| format!("?{place}")).collect();
        let text = format!(
            "SELECT {COLUMNS} FROM jobs INDEXED BY jobs_id WHERE id IN ({})",
            places.join(", ")
        );
        let parameters: Vec<_> = ids.iter().map(|id| Value::from(*id)).collect();
        for row in sql.query(&text, &parameters)? {
            let job = rows::job(&row)?;
            found.insert(job.id, Arc::new(job));
        }
    }
    Ok(found)
}

/// Whether there are no jobs.
pub(in crate::queue) fn is_empty(sql: &dyn Sql) -> Result<bool, QueueError> {
    Ok(sql.first("SELECT seq FROM jobs LIMIT 1", &[])?.is_none())
}

/// The statement that counts the load by state, tenant, priority and device requirement.
pub(in crate::queue) const LOADS: &str = "SELECT state, tenant, priority, device, \
    count(*) AS jobs, sum(cost) AS seconds FROM jobs WHERE state < 2 \
    AND (kind = 0 OR ready IS NOT NULL) GROUP BY state, tenant, priority, device";

/// The backlog of the rows of [`LOADS`].
pub(in crate::queue) fn backlog_of(rows: &[Row]) -> Result<Backlog, QueueError> {
    let mut backlog = Backlog::default();
    for row in rows {
        let load = Load {
            jobs: u64::from(row.get::<u32>(4)?),
            seconds: row.get(5)?,
        };
        let key = BacklogKey {
            tenant: row.get(1)?,
            priority: row.choice(2, &Priority::ALL)?,
            device: row.choice(3, &DEVICES)?,
        };
        match row.choice(0, &State::ALL)? {
            State::Queued => backlog.enter_many(key, load),
            _ => backlog.start_many(load),
        }
    }
    Ok(backlog)
}

/// Counts the queued and the running load.
pub(in crate::queue) fn count_backlog(sql: &dyn Sql) -> Result<Backlog, QueueError> {
    backlog_of(&sql.query(LOADS, &[])?)
}
