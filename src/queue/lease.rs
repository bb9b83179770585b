//! A worker's hold on a job, and the sign of life that keeps it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use super::Progress;
use crate::job::Job;

/// A job that one worker may work on.
#[derive(Debug)]
pub struct Lease {
    /// The job, running.
    pub job: Arc<Job>,
    /// Given from the iteration loop.
    pub pulse: Pulse,
}

/// What a worker is to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// Go on.
    Continue,
    /// Stop: nobody wants the flow any more.
    Cancel,
    /// Stop: the lease ran out and somebody else may hold the job.
    Lost,
}

/// What the queue tells a worker without being asked, and when it heard of it last.
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
            last_beat: Mutex::new(Instant::now()),
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

    pub(super) fn lose(&self) {
        self.lost.store(true, Ordering::Relaxed);
    }

    /// The worker is alive.
    pub(super) fn beat(&self) {
        let mut last = self
            .last_beat
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        *last = Instant::now();
    }

    /// When the worker was last alive.
    pub(super) fn last_beat(&self) -> Instant {
        *self
            .last_beat
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where signs of life go.
pub(super) trait Heart: Send + Sync {
    /// A sign of life, with progress where there is news.
    fn beat(&self, progress: Option<Progress>);
    /// A snapshot lies in store: a crash from here on is not the job's second at the same place.
    fn snapshot_kept(&self);
}

/// A lease's sign of life; cheap enough for every iteration. It is given by the loop itself, not
/// by a timer, so that a device that hangs loses its lease.
#[derive(Clone)]
pub struct Pulse {
    flags: Arc<Flags>,
    heart: Arc<dyn Heart>,
}

impl std::fmt::Debug for Pulse {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pulse")
            .field("signal", &self.signal())
            .finish_non_exhaustive()
    }
}

impl Pulse {
    pub(super) fn new(flags: Arc<Flags>, heart: Arc<dyn Heart>) -> Self {
        Self { flags, heart }
    }

    /// A sign of life; says what to do.
    pub fn beat(&self, progress: Option<Progress>) -> Signal {
        self.flags.beat();
        self.heart.beat(progress);
        self.signal()
    }

    /// What to do, without a sign of life.
    pub fn signal(&self) -> Signal {
        if self.flags.lost.load(Ordering::Relaxed) {
            Signal::Lost
        } else if self.flags.cancel.load(Ordering::Relaxed) {
            Signal::Cancel
        } else {
            Signal::Continue
        }
    }

    /// Whether the job outlives its caller by now, whatever it was when it was leased.
    pub fn is_durable(&self) -> bool {
        self.flags.is_durable()
    }

    /// Says that a snapshot lies in store.
    pub fn snapshot_kept(&self) {
        self.heart.snapshot_kept();
    }
}
