//! State that the writer thread shares with other threads: subscriptions, backlog and running jobs.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::sync::{Notify, mpsc};
use tokio_util::sync::CancellationToken;

use super::effects::Effects;
use crate::job::JobId;
use crate::queue::backlog::Backlog;
use crate::queue::lease::Flags;
use crate::queue::subscriptions::Watchers;
use crate::queue::types::Event;
use crate::sync::locked;

/// In-memory state that the writer thread updates after each commit.
pub(in crate::queue) struct Shared {
    pub(super) watchers: Watchers,
    pub(super) backlog: Mutex<Backlog>,
    pub(super) running: Mutex<HashMap<JobId, Running>>,
    pub(super) ready: Notify,
    events: mpsc::UnboundedSender<Event>,
    /// Cancelled when the writer thread has ended.
    pub(super) ended: CancellationToken,
}

/// A job that a worker holds.
pub(super) struct Running {
    pub(super) attempt: u32,
    pub(super) flags: Arc<Flags>,
}

impl Shared {
    pub(super) fn new(events: mpsc::UnboundedSender<Event>) -> Self {
        Self {
            watchers: Watchers::default(),
            backlog: Mutex::default(),
            running: Mutex::default(),
            ready: Notify::new(),
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
        {
            let mut backlog = locked(&self.backlog);
            let mut running = locked(&self.running);
            // A job may enter and leave in one commit, so entries are counted first.
            for job in &effects.entered {
                backlog.entered(job);
            }
            for job in &effects.left {
                backlog.left(job);
            }
            for job in &effects.stopped {
                backlog.stopped(job);
                if let Some(held) = running.remove(&job.id) {
                    held.flags.mark_lost();
                }
            }
            for job in &effects.started {
                backlog.started(job);
                let held = Running {
                    attempt: job.attempt,
                    flags: Arc::default(),
                };
                running.insert(job.id, held);
            }
            for job in effects.changed.iter().filter(|job| job.durable) {
                if let Some(held) = running.get(&job.id) {
                    held.flags.make_durable();
                }
            }
            for id in &effects.cancel {
                if let Some(held) = running.get(id) {
                    held.flags.cancel();
                }
            }
        }
        for job in &effects.changed {
            self.watchers.push(job);
        }
        if !effects.entered.is_empty() || !effects.changed.is_empty() {
            self.ready.notify_waiters();
        }
        for event in effects.events {
            let _nobody_listens_is_fine = self.events.send(event);
        }
    }
}
