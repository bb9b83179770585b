//! The thread that looks after the queue for this node: it reads the jobs that this process watches
//! or holds, tells the other nodes what has changed, renews leases, and handles what is due.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

use super::bell::Changes;
use super::locks::SWEEP;
use super::nodes::GRACE;
use super::presence::CHANNEL;
use super::session::{Call, Flush, Session};
use super::shared::Shared;
use crate::job::JobId;
use crate::queue::effects::Effects;
use crate::queue::sql::{Sql, values};
use crate::queue::transitions::{expiry, leases, lists};
use crate::queue::types::{Outcome, QueueError};
use crate::sync::locked;

/// How long the upkeep waits for changes of this process at most.
const TICK: Duration = Duration::from_millis(250);

/// Interval between two reads of all jobs that this process watches or holds.
const READ_INTERVAL: Duration = Duration::from_secs(1);

/// Minimum interval between two notifications of a node: each takes a lock of the whole database,
/// and each node hears all of them.
const TELL_INTERVAL: Duration = Duration::from_millis(100);

/// Nodes beyond which notifications that nobody waits for are sent less often.
const FEW_NODES: u32 = 4;

/// How long rows that are due are handled in one turn.
const AT_A_TIME: Duration = Duration::from_millis(50);

/// Number of ended jobs that are deleted in one transaction. Each waits for the disk.
const FORGOTTEN_AT_ONCE: usize = 64;

/// Time after which a claimed job is given back that no worker took.
const NOT_TAKEN: Duration = Duration::from_secs(2);

/// Maximum number of heartbeats in one transaction.
const AT_ONCE: usize = 64;

/// Interval between two renewals of a lease; a quarter of the lease if that is shorter.
const BEAT_INTERVAL: Duration = Duration::from_secs(1);

/// The pause after an error.
const PAUSE: Duration = Duration::from_millis(200);

/// A turn takes less while the database answers.
const LONGEST_TURN: Duration = Duration::from_secs(2);

/// How many of the jobs that were due are handled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Handled {
    All,
    /// The rest is due still.
    InPart,
    /// None: another node is at it.
    ByAnotherNode,
}

/// The upkeep of a node, on its own connection.
pub(super) struct Upkeep {
    shared: Arc<Shared>,
    session: Session,
    untold: Changes,
    told: Instant,
    read: Instant,
    beaten: Instant,
    /// Whether rows are due that the last turn had no time for.
    is_behind: bool,
    /// When the rows that are due were last read.
    seen: Instant,
    /// When the last pause ended in which they were not read.
    awake_since: Instant,
    /// Whether a row that was due could not be handled. Each is then handled for itself, so that it does
    /// not keep the others from it.
    has_failed: bool,
}

impl Upkeep {
    pub(super) fn new(shared: Arc<Shared>, session: Session) -> Self {
        let now = Instant::now();
        Self {
            shared,
            session,
            untold: Changes::default(),
            told: now,
            read: now,
            beaten: now,
            is_behind: false,
            seen: now,
            awake_since: now,
            has_failed: false,
        }
    }

    /// Goes on until the queue is dropped.
    pub(super) fn run(mut self) {
        while !self.shared.is_stopping() {
            if let Err(error) = self.turn() {
                tracing::warn!(%error, "the queue's database cannot be looked after");
                self.session.close();
                thread::sleep(PAUSE);
            }
        }
        if let Err(error) = self.beat() {
            tracing::warn!(%error, "the last heartbeats were not written");
        }
    }

    fn turn(&mut self) -> Result<(), QueueError> {
        let rung = self.shared.bell.wait(self.patience());
        let mut to_read = rung.elsewhere;
        to_read.jobs.extend(rung.here.jobs.iter().copied());
        self.untold.merge(rung.here);
        if self.read.elapsed() >= READ_INTERVAL {
            to_read.more = true;
        }
        if to_read.more {
            self.read = Instant::now();
        }
        if rung.beat_now || self.beaten.elapsed() >= self.beat_interval() {
            self.beat()?;
        }
        self.read_again(&to_read)?;
        self.handle_what_is_due()?;
        self.give_back()?;
        self.tell()
    }

    /// How long this turn waits for changes.
    fn patience(&self) -> Duration {
        let until_told = self.tell_interval().saturating_sub(self.told.elapsed());
        let until_beat = self.beat_interval().saturating_sub(self.beaten.elapsed());
        let tick = if self.is_behind { Duration::ZERO } else { TICK };
        match self.untold.is_empty() {
            true => tick.min(until_beat),
            false => tick.min(until_beat).min(until_told),
        }
    }

    /// The interval between notifications, longer in a large fleet unless somebody waits.
    fn tell_interval(&self) -> Duration {
        if self.untold.urgent {
            return TELL_INTERVAL;
        }
        let nodes = self.shared.nodes.load(Ordering::Relaxed);
        TELL_INTERVAL * (nodes / FEW_NODES).max(1)
    }

    fn beat_interval(&self) -> Duration {
        BEAT_INTERVAL.min(self.shared.options.lease / 4)
    }

    /// Renews the leases of which there were heartbeats.
    fn beat(&mut self) -> Result<(), QueueError> {
        self.beaten = Instant::now();
        let options = &self.shared.options;
        let mut beats: Vec<_> = self.shared.beats.take().into_iter().collect();
        // A cancellation locks the pairs of a sequence in this order, too.
        beats.sort_unstable_by_key(|((id, _), _)| *id);
        for beats in beats.chunks(AT_ONCE) {
            let renew = |sql: &dyn Sql, _: &mut Effects| {
                for ((id, attempt), beat) in beats {
                    if beat.snapshot_kept {
                        leases::snapshot_kept(sql, *id, *attempt)?;
                    }
                    leases::beat(sql, options, *id, *attempt, beat.progress)?;
                }
                Ok(())
            };
            self.session.transact(Flush::Never, Call::own(), renew)?;
        }
        self.shared.beats.written();
        Ok(())
    }

    /// Reads the jobs that this process watches or holds, as far as they may have changed.
    fn read_again(&mut self, changes: &Changes) -> Result<(), QueueError> {
        let local = &self.shared.local;
        let held: Vec<JobId> = locked(&local.running).keys().copied().collect();
        let watched = local.watchers.jobs();
        let mut ids: Vec<JobId> = held.into_iter().chain(watched).collect();
        ids.retain(|id| changes.contains(*id));
        ids.sort_unstable();
        ids.dedup();
        let found = self
            .session
            .read(Instant::now(), |sql| lists::find_all(sql, &ids))?;
        for id in ids {
            local.refresh(id, found.get(&id));
        }
        Ok(())
    }

    /// Tells the other nodes what has changed here.
    fn tell(&mut self) -> Result<(), QueueError> {
        if self.untold.is_empty() || self.told.elapsed() < self.tell_interval() {
            return Ok(());
        }
        let payload = self.untold.to_payload();
        let text = format!("SELECT pg_notify('{CHANNEL}', ?1)::text");
        self.session.read(Instant::now(), |sql| {
            sql.query(&text, values![payload.as_str()])
        })?;
        self.untold = Changes::default();
        self.told = Instant::now();
        Ok(())
    }

    /// Gives back the jobs that were claimed for a worker that had stopped waiting.
    fn give_back(&mut self) -> Result<(), QueueError> {
        for (id, attempt) in self.shared.local.not_taken(NOT_TAKEN) {
            let options = &self.shared.options;
            let release = |sql: &dyn Sql, effects: &mut Effects| {
                leases::finish(sql, effects, options, id, attempt, Outcome::Released)
            };
            let session = &mut self.session;
            self.shared
                .change(session, Flush::IfWritten, Call::own(), release)?;
        }
        Ok(())
    }

    /// Handles the rows that are due, unless another node does, for a moment: heartbeats and
    /// cancellations are not to wait.
    fn handle_what_is_due(&mut self) -> Result<(), QueueError> {
        let due = self.session.read(Instant::now(), expiry::due)?;
        // A database that hung, or a pause of this process: leases were not renewed meanwhile.
        if self.seen.elapsed() > LONGEST_TURN + self.shared.options.lease / 2 {
            self.awake_since = Instant::now();
        }
        self.seen = Instant::now();
        let at_once = match std::mem::take(&mut self.has_failed) {
            true => 1,
            false => FORGOTTEN_AT_ONCE,
        };
        let began = Instant::now();
        self.is_behind = due.has_more;
        for jobs in due.open.chunks(1).chain(due.ended.chunks(at_once)) {
            if began.elapsed() > AT_A_TIME {
                self.is_behind = true;
                break;
            }
            match self.look_after(jobs) {
                Ok(Handled::All) => {}
                Ok(Handled::InPart) => {
                    self.is_behind = true;
                    break;
                }
                Ok(Handled::ByAnotherNode) => {
                    self.is_behind = false;
                    break;
                }
                Err(error) => {
                    self.has_failed = true;
                    tracing::error!(%error, ?jobs, "jobs that are due are not handled");
                }
            }
        }
        self.is_behind &= !self.has_failed;
        Ok(())
    }

    /// Handles jobs whose rows are due in one transaction, for a moment.
    fn look_after(&mut self, jobs: &[JobId]) -> Result<Handled, QueueError> {
        // No lease was renewed while the database could not be reached.
        let options = &self.shared.options;
        let grace = GRACE.min(options.lease);
        let reached_for = self.session.age().min(self.awake_since.elapsed());
        let left = (reached_for < grace).then_some(grace);
        let lock = format!("SELECT pg_try_advisory_xact_lock({SWEEP}, 0)");
        let look = |sql: &dyn Sql, effects: &mut Effects| {
            if !sql.only(&lock, &[])?.get::<bool>(0)? {
                return Ok(Handled::ByAnotherNode);
            }
            let began = Instant::now();
            for (handled, id) in jobs.iter().enumerate() {
                if handled > 0 && began.elapsed() > AT_A_TIME {
                    return Ok(Handled::InPart);
                }
                expiry::look_after(sql, effects, options, *id, left)?;
            }
            Ok(Handled::All)
        };
        let session = &mut self.session;
        self.shared
            .change(session, Flush::Always, Call::own(), look)
    }
}
