//! The load of all nodes: counted in the database now and then by one of them, and kept exact with
//! the commits of this node in between.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::locks::COUNT;
use super::session::{Call, Flush, Session};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Priority};
use crate::queue::backlog::{Backlog, BacklogKey, Load};
use crate::queue::effects::Effects;
use crate::queue::local::Local;
use crate::queue::sql::{Sql, values};
use crate::queue::transitions::lists;
use crate::queue::types::QueueError;
use crate::sync::locked;

/// Minimum time between two counts.
pub(super) const INTERVAL: Duration = Duration::from_secs(1);

/// Number of commits that are remembered until a count has seen them. The next count sees those before
/// them.
const UNSEEN: usize = 20_000;

/// Time since the last count after which no node was there, or counts take long.
const LATELY_MS: i64 = 3000;

/// The transactions that a count has seen, in the form of `pg_current_snapshot()`.
#[derive(Debug, Default, PartialEq, Eq)]
struct Snapshot {
    /// All before this one had ended.
    from: u64,
    /// This one and later ones had not begun.
    to: u64,
    /// Those between that had not ended.
    open: Vec<u64>,
}

impl Snapshot {
    fn parse(text: &str) -> Option<Self> {
        let mut parts = text.split(':');
        let from = parts.next()?.parse().ok()?;
        let to = parts.next()?.parse().ok()?;
        let open = parts.next()?.split(',').filter(|open| !open.is_empty());
        let open = open.map(str::parse).collect::<Result<_, _>>().ok()?;
        Some(Self { from, to, open })
    }

    fn has_seen(&self, transaction: u64) -> bool {
        transaction < self.from || (transaction < self.to && !self.open.contains(&transaction))
    }
}

/// The commits of this node that the last count has not seen.
#[derive(Debug, Default)]
struct Unseen {
    last: Snapshot,
    commits: VecDeque<(u64, Effects)>,
}

/// Keeps the backlog of this process.
#[derive(Debug, Default)]
pub(super) struct Ledger(Mutex<Unseen>);

impl Ledger {
    /// Adds a commit of this node to the backlog, unless the last count has seen it.
    pub(super) fn add(&self, local: &Local, effects: &Effects, transaction: Option<u64>) {
        let Some(transaction) = transaction else {
            return;
        };
        let mut unseen = locked(&self.0);
        if unseen.last.has_seen(transaction) {
            return;
        }
        effects.change(&mut locked(&local.backlog));
        if unseen.commits.len() >= UNSEEN {
            unseen.commits.pop_front();
        }
        unseen.commits.push_back((transaction, effects.of_load()));
    }

    /// Replaces the backlog by a count and the commits that it has not seen.
    fn counted(&self, local: &Local, snapshot: Snapshot, mut counted: Backlog) {
        let mut unseen = locked(&self.0);
        if snapshot == unseen.last {
            return;
        }
        unseen.commits.retain(|(transaction, effects)| {
            let is_new = !snapshot.has_seen(*transaction);
            if is_new {
                effects.change(&mut counted);
            }
            is_new
        });
        unseen.last = snapshot;
        *locked(&local.backlog) = counted;
    }
}

/// Counts the load if the last count of any node is older than [`INTERVAL`], and takes the last
/// count over. With `at_once` it counts however old the last count is.
pub(super) fn refresh(
    session: &mut Session,
    ledger: &Ledger,
    local: &Local,
    at_once: bool,
) -> Result<(), QueueError> {
    let commit = session.transact(Flush::Never, Call::own(), |sql, _: &mut Effects| {
        count_if_old(sql, at_once)?;
        sql.only("SELECT snapshot, load FROM summary", &[])
    })?;
    let (snapshot, load): (String, String) = (commit.value.get(0)?, commit.value.get(1)?);
    let unreadable = || QueueError::Store("the summary of the load cannot be read".to_owned());
    if let Some(snapshot) = Snapshot::parse(&snapshot) {
        let load: Summary = serde_json::from_str(&load).map_err(|_| unreadable())?;
        let load = load.to_backlog().ok_or_else(unreadable)?;
        ledger.counted(local, snapshot, load);
    }
    Ok(())
}

/// Whether a node has counted the load a moment ago. Otherwise all have ended, or were cut off from the
/// database.
pub(super) fn was_counted_lately(session: &mut Session) -> Result<bool, QueueError> {
    session.read(Instant::now(), |sql| {
        let load: String = sql.only("SELECT load FROM summary", &[])?.get(0)?;
        let at = serde_json::from_str(&load).map_or(0, |load: Summary| load.at);
        Ok(sql.now().as_millis() - at < LATELY_MS)
    })
}

fn count_if_old(sql: &dyn Sql, at_once: bool) -> Result<(), QueueError> {
    // A count that takes long is made less often.
    let due = "SELECT taken FROM summary WHERE taken <= ?1";
    if !at_once && sql.first(due, values![sql.now()])?.is_none() {
        return Ok(());
    }
    let lock = format!("SELECT pg_try_advisory_xact_lock({COUNT}, 0)");
    if !sql.only(&lock, &[])?.get::<bool>(0)? {
        return Ok(());
    }
    let began = Instant::now();
    // One statement, so that the snapshot is that of the counts.
    let text = format!(
        "SELECT state, tenant, priority, device, jobs, seconds, snapshot \
         FROM (SELECT pg_current_snapshot()::text AS snapshot) AS taken \
         LEFT JOIN ({}) AS loads ON true",
        lists::LOADS
    );
    let mut rows = sql.query(&text, &[])?;
    let snapshot: String = match rows.first() {
        Some(row) => row.get(6)?,
        None => return Ok(()),
    };
    rows.retain(|row| row.get::<Option<u32>>(0) != Ok(None));
    let summary = Summary::of(&lists::backlog_of(&rows)?, sql.now());
    let load =
        serde_json::to_string(&summary).map_err(|error| QueueError::Store(error.to_string()))?;
    let next = sql.now().after(INTERVAL.max(began.elapsed() * 20));
    sql.query(
        "UPDATE summary SET taken = ?1, snapshot = ?2, load = ?3",
        values![next, snapshot.as_str(), load.as_str()],
    )?;
    Ok(())
}

/// The load as it is stored: seconds and jobs.
#[derive(Debug, Serialize, Deserialize)]
struct Summary {
    /// When it was counted, milliseconds since 1970; 0 where an older node did.
    #[serde(default)]
    at: i64,
    running: (u64, f64),
    /// Tenant, priority, device kind, jobs, seconds.
    queued: Vec<(String, Priority, Option<DeviceKind>, u64, f64)>,
}

impl Summary {
    fn of(backlog: &Backlog, at: Timestamp) -> Self {
        let running = backlog.running();
        let queued = backlog.queued_loads().map(|(key, load)| {
            let tenant = key.tenant.as_str().to_owned();
            (tenant, key.priority, key.device, load.jobs, load.seconds)
        });
        Self {
            at: at.as_millis(),
            running: (running.jobs, running.seconds),
            queued: queued.collect(),
        }
    }

    fn to_backlog(&self) -> Option<Backlog> {
        let (jobs, seconds) = self.running;
        let mut backlog = Backlog::default();
        backlog.start_many(Load { jobs, seconds });
        for (tenant, priority, device, jobs, seconds) in &self.queued {
            let key = BacklogKey {
                tenant: tenant.parse().ok()?,
                priority: *priority,
                device: *device,
            };
            let (jobs, seconds) = (*jobs, *seconds);
            backlog.enter_many(key, Load { jobs, seconds });
        }
        Some(backlog)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commits_that_no_count_has_seen_do_not_pile_up() {
        let (events, _heard) = tokio::sync::mpsc::unbounded_channel();
        let (ledger, local) = (Ledger::default(), Local::new(events));
        for transaction in 0..UNSEEN as u64 + 10 {
            ledger.add(&local, &Effects::default(), Some(transaction));
        }
        let unseen = locked(&ledger.0);
        let kept = [unseen.commits.front(), unseen.commits.back()];
        let kept = kept.map(|of| of.map(|(transaction, _)| *transaction));
        assert_eq!(kept, [Some(10), Some(UNSEEN as u64 + 9)]);
    }

    #[test]
    fn a_snapshot_has_seen_what_had_ended_before_it() {
        let snapshot = Snapshot::parse("10:14:10,12").expect("a snapshot");
        let seen = [9, 10, 11, 12, 13, 14].map(|number| snapshot.has_seen(number));
        assert_eq!(seen, [true, false, true, false, true, false]);
        let quiet = Snapshot::parse("10:10:").expect("a snapshot");
        assert!(quiet.has_seen(9) && !quiet.has_seen(10));
        assert_eq!(Snapshot::parse(""), None);
    }
}
