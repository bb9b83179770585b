//! The lease of a job, and the heartbeat that keeps it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use super::time;
use crate::job::{Job, JobProgress};
use crate::sync::locked;

/// A job leased to one worker. Dropping the lease does not release the job; [`Queue::finish`] does.
///
/// [`Queue::finish`]: super::Queue::finish
#[derive(Debug)]
pub struct Lease {
    /// The job, in state running.
    pub job: Arc<Job>,
    /// The heartbeat, which keeps the lease.
    pub heartbeat: LeaseHeartbeat,
}

/// The queue's instruction to a worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// Continue the work.
    Continue,
    /// Stop: the job's cancellation was requested.
    Cancel,
    /// Stop: the attempt no longer holds the job, because its lease has expired or it was finished.
    /// Another worker may hold the job.
    Lost,
}

/// Flags that the queue sets for a running job, and the time of the last heartbeat.
#[derive(Debug)]
pub(super) struct Flags {
    cancel: AtomicBool,
    lost: AtomicBool,
    durable: AtomicBool,
    /// On the monotonic clock.
    last_beat: Mutex<Instant>,
}

impl Default for Flags {
    fn default() -> Self {
        Self {
            cancel: AtomicBool::default(),
            lost: AtomicBool::default(),
            durable: AtomicBool::default(),
            last_beat: Mutex::new(time::monotonic()),
        }
    }
}

impl Flags {
    pub(super) fn cancel(&self) {
        self.cancel.store(true, Ordering::Relaxed);
    }

    pub(super) fn make_durable(&self) {
        self.durable.store(true, Ordering::Relaxed);
    }

    pub(super) fn is_durable(&self) -> bool {
        self.durable.load(Ordering::Relaxed)
    }

    pub(super) fn mark_lost(&self) {
        self.lost.store(true, Ordering::Relaxed);
    }

    /// Records a heartbeat.
    pub(super) fn beat(&self) {
        let mut last = locked(&self.last_beat);
        *last = time::monotonic();
    }

    /// Time of the last heartbeat.
    pub(super) fn last_beat(&self) -> Instant {
        *locked(&self.last_beat)
    }
}

/// Sink of a lease's heartbeats.
pub(super) trait HeartbeatStore: Send + Sync {
    /// A heartbeat, with progress if there is any.
    fn beat(&self, progress: Option<JobProgress>);
    /// A snapshot was stored: resets the crash counter of the job.
    fn snapshot_kept(&self);
}

/// The heartbeat of a lease, cheap enough for every iteration. Clones share the lease.
///
/// During an estimate the iteration loop calls it, not a timer. The lease of a job on a device that
/// hangs therefore expires.
#[derive(Clone)]
pub struct LeaseHeartbeat {
    flags: Arc<Flags>,
    store: Arc<dyn HeartbeatStore>,
}

impl std::fmt::Debug for LeaseHeartbeat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LeaseHeartbeat")
            .field("signal", &self.signal())
            .finish_non_exhaustive()
    }
}

impl LeaseHeartbeat {
    pub(super) fn new(flags: Arc<Flags>, store: Arc<dyn HeartbeatStore>) -> Self {
        Self { flags, store }
    }

    /// Renews the lease for [`QueueOptions::lease`] and returns the queue's current instruction.
    /// `progress` is published to the subscribers of the job; `None` leaves it unchanged. A lost
    /// lease is not renewed.
    ///
    /// The call does not wait for the store. The store writes a renewal at most once a second, or
    /// once in a quarter of the lease if that is shorter.
    ///
    /// [`QueueOptions::lease`]: super::QueueOptions::lease
    pub fn beat(&self, progress: Option<JobProgress>) -> Signal {
        self.flags.beat();
        self.store.beat(progress);
        self.signal()
    }

    /// The current instruction, without a heartbeat. If the lease is lost and a cancellation was
    /// requested, it is [`Signal::Lost`].
    pub fn signal(&self) -> Signal {
        if self.flags.lost.load(Ordering::Relaxed) {
            Signal::Lost
        } else if self.flags.cancel.load(Ordering::Relaxed) {
            Signal::Cancel
        } else {
            Signal::Continue
        }
    }

    /// Whether the job is durable by now. It may have become durable after it was leased.
    pub fn is_durable(&self) -> bool {
        self.flags.is_durable()
    }

    /// Reports that a snapshot was stored, which resets the job's count of crashes to 0.
    pub fn snapshot_kept(&self) {
        self.store.snapshot_kept();
    }
}
