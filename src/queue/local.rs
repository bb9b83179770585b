//! What this process knows of the queue: subscriptions, the backlog, and the jobs its workers hold.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::sync::futures::Notified;
use tokio::sync::{Notify, mpsc};
use tokio_util::sync::CancellationToken;

use super::backlog::Backlog;
use super::effects::Effects;
use super::lease::Flags;
use super::subscriptions::Watchers;
use super::time;
use super::types::Event;
use crate::job::{DeviceKind, Job, JobId, State};
use crate::sync::locked;

/// In-memory state that is updated after each commit.
pub(super) struct Local {
    pub(super) watchers: Watchers,
    pub(super) backlog: Mutex<Backlog>,
    pub(super) running: Mutex<HashMap<JobId, Running>>,
    /// Wakes the workers that wait for a job.
    ready: Notify,
    /// How often a job may have become ready.
    changes: AtomicU64,
    looks: [LastLook; DeviceKind::ALL.len()],
    looked: Mutex<Instant>,
    events: mpsc::UnboundedSender<Event>,
    /// Cancelled when nothing can be written any more.
    pub(super) ended: CancellationToken,
}

/// The last look for a job by the workers of one kind of device.
#[derive(Debug, Default)]
struct LastLook {
    turn: tokio::sync::Mutex<()>,
    /// The value of `changes` at which there was no job.
    empty_at: AtomicU64,
}

/// The result of a look for a job.
pub(super) enum Look<T> {
    /// A job was claimed.
    Found(T),
    /// No job is ready.
    Empty,
    /// The worker has left. Nothing was claimed.
    GivenUp,
}

/// A job that a worker of this process holds.
pub(super) struct Running {
    pub(super) attempt: u32,
    pub(super) flags: Arc<Flags>,
    since: Instant,
    /// Whether the worker that asked for a job got this one. It may have stopped waiting.
    is_taken: bool,
}

impl Local {
    pub(super) fn new(events: mpsc::UnboundedSender<Event>) -> Self {
        Self {
            watchers: Watchers::default(),
            backlog: Mutex::default(),
            running: Mutex::default(),
            ready: Notify::new(),
            changes: AtomicU64::new(1),
            looks: Default::default(),
            looked: Mutex::new(Instant::now()),
            events,
            ended: CancellationToken::new(),
        }
    }

    /// The remaining lease of a job at `now`, by the last heartbeat on the monotonic clock; `None`
    /// if it has expired. The lease on disk follows the wall clock, which may be set, and only
    /// triggers this check.
    pub(super) fn lease_left(&self, id: JobId, lease: Duration, now: Instant) -> Option<Duration> {
        let last_beat = locked(&self.running).get(&id)?.flags.last_beat();
        let left = lease.checked_sub(now.saturating_duration_since(last_beat))?;
        (!left.is_zero()).then_some(left)
    }

    /// Counts a heartbeat for every worker, after a pause of the whole process in which they could
    /// send none.
    pub(super) fn all_are_alive(&self) {
        for held in locked(&self.running).values() {
            held.flags.beat();
        }
    }

    /// Applies the effects of a commit.
    pub(super) fn apply(&self, effects: Effects) {
        effects.change(&mut locked(&self.backlog));
        self.apply_to_running(&effects);
        for job in &effects.changed {
            self.watchers.push(job);
        }
        self.tell(effects);
    }

    /// Updates the jobs that workers of this process hold.
    pub(super) fn apply_to_running(&self, effects: &Effects) {
        let mut running = locked(&self.running);
        // Commits of several connections may come here in another order than they were made.
        let holds = |held: &Running, attempt| held.attempt == attempt;
        for job in &effects.stopped {
            if let Some(held) = running.get(&job.id)
                && holds(held, job.attempt)
            {
                held.flags.mark_lost();
                running.remove(&job.id);
            }
        }
        for job in &effects.started {
            if running
                .get(&job.id)
                .is_some_and(|held| held.attempt > job.attempt)
            {
                continue;
            }
            let held = Running {
                attempt: job.attempt,
                flags: Arc::default(),
                since: time::monotonic(),
                is_taken: false,
            };
            running.insert(job.id, held);
        }
        for job in effects.changed.iter().filter(|job| job.durable) {
            if let Some(held) = running.get(&job.id) {
                held.flags.make_durable();
            }
        }
        for (id, attempt) in &effects.cancel {
            if let Some(held) = running.get(id)
                && holds(held, *attempt)
            {
                held.flags.cancel();
            }
        }
    }

    /// Wakes the waiting workers and sends the events.
    pub(super) fn tell(&self, effects: Effects) {
        if !effects.entered.is_empty() || !effects.changed.is_empty() {
            self.wake();
        }
        for event in effects.events {
            let _nobody_listens_is_fine = self.events.send(event);
        }
    }

    /// Wakes the workers that wait for a job: one may have become ready.
    pub(super) fn wake(&self) {
        self.changes.fetch_add(1, Ordering::Relaxed);
        self.ready.notify_waiters();
    }

    /// A wait for the next [`Local::wake`] from now on.
    pub(super) fn woken(&self) -> Notified<'_> {
        self.ready.notified()
    }

    /// Has the workers look again, at most once in `interval`.
    pub(super) fn look_again(&self, interval: Duration) {
        let mut looked = locked(&self.looked);
        if looked.elapsed() >= interval {
            *looked = Instant::now();
            self.changes.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Looks for a job with `claim`, unless `until` is ready or another worker of this kind has just
    /// found none. The workers of a kind look one after the other, so that many idle ones cost as
    /// much as one.
    pub(super) async fn look<T, E>(
        &self,
        kind: DeviceKind,
        until: Pin<&mut (dyn Future<Output = ()> + Send)>,
        claim: impl Future<Output = Result<Option<T>, E>>,
    ) -> Result<Look<T>, E> {
        let last = &self.looks[kind as usize];
        let _turn = tokio::select! {
            biased;
            () = until => return Ok(Look::GivenUp),
            turn = last.turn.lock() => turn,
        };
        let changes = self.changes.load(Ordering::Relaxed);
        if last.empty_at.load(Ordering::Relaxed) == changes {
            return Ok(Look::Empty);
        }
        let found = claim.await?;
        if found.is_none() {
            last.empty_at.store(changes, Ordering::Relaxed);
        }
        Ok(found.map_or(Look::Empty, Look::Found))
    }

    /// Takes over the state of a job as it was just read, `None` if it was removed: for the worker
    /// that holds it and for its subscribers.
    pub(super) fn refresh(&self, id: JobId, job: Option<&Arc<Job>>) {
        let is_held = {
            let mut running = locked(&self.running);
            match (running.get(&id), job) {
                (None, _) => false,
                (Some(held), Some(job)) if job.attempt < held.attempt => {
                    // It was read before it was claimed.
                    return;
                }
                (Some(held), Some(job))
                    if job.attempt == held.attempt && job.state == State::Running =>
                {
                    if job.cancel_requested {
                        held.flags.cancel();
                    }
                    if job.durable {
                        held.flags.make_durable();
                    }
                    true
                }
                (Some(held), _) => {
                    held.flags.mark_lost();
                    running.remove(&id);
                    false
                }
            }
        };
        match job {
            Some(job) => self.watchers.refresh(job, is_held),
            None => self.watchers.forget(id),
        }
    }

    /// The claimed jobs that no worker has taken for this long.
    pub(super) fn not_taken(&self, for_long: Duration) -> Vec<(JobId, u32)> {
        let running = locked(&self.running);
        let left = running
            .iter()
            .filter(|(_, held)| !held.is_taken && time::monotonic() - held.since > for_long);
        left.map(|(id, held)| (*id, held.attempt)).collect()
    }

    /// The flags of a job that was just claimed.
    pub(super) fn flags_of(&self, job: &Job) -> Arc<Flags> {
        match locked(&self.running).get_mut(&job.id) {
            Some(held) if held.attempt == job.attempt => {
                held.is_taken = true;
                Arc::clone(&held.flags)
            }
            // The lease was lost after the claim.
            _ => {
                let flags = Flags::default();
                flags.mark_lost();
                Arc::new(flags)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::queue::contract_tests::{done, submission};
    use crate::queue::types::{QueueOptions, Submitted};
    use crate::queue::{Outcome, open_sqlite};

    #[tokio::test]
    async fn a_commit_that_comes_late_takes_no_job_from_its_next_attempt() {
        // Two attempts at one job, as a queue makes them.
        let folder = tempfile::tempdir().expect("a folder");
        let (events, _heard) = mpsc::unbounded_channel();
        let queue = open_sqlite(folder.path(), QueueOptions::default(), events.clone());
        let queue = queue.expect("a queue");
        let Ok(Submitted::New(_)) = queue.submit(submission("a")).await else {
            panic!("it is new");
        };
        let first = queue.lease("worker", DeviceKind::Cpu).await;
        let first = first.expect("a lease").job;
        let released = queue.finish(first.id, first.attempt, Outcome::Released);
        released.await.expect("the store works");
        let second = queue.lease("worker", DeviceKind::Cpu).await;
        let second = second.expect("a lease").job;

        let local = Local::new(events);
        let started = |job: &Arc<Job>| Effects {
            started: vec![Arc::clone(job)],
            ..Effects::default()
        };
        local.apply_to_running(&started(&first));
        local.apply_to_running(&started(&second));
        let flags = local.flags_of(&second);
        local.apply_to_running(&Effects {
            stopped: vec![Arc::clone(&first)],
            cancel: vec![(first.id, first.attempt)],
            ..Effects::default()
        });
        local.apply_to_running(&started(&first));
        assert!(Arc::ptr_eq(&flags, &local.flags_of(&second)));
        assert_eq!(local.not_taken(Duration::ZERO), []);
        let ended = queue.finish(second.id, second.attempt, done()).await;
        ended.expect("the store works");
    }
}
