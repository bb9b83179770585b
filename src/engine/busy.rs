//! How long a lane has worked, and when it was last heard of.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Time at work, the current piece of it included.
#[derive(Debug)]
pub(super) struct Busy {
    epoch: Instant,
    /// Microseconds after `epoch` of the latest sign of life.
    alive: AtomicU64,
    before_micros: AtomicU64,
    /// Microseconds after `epoch` at which the current piece began, plus one; zero when idle.
    since: AtomicU64,
}

impl Default for Busy {
    fn default() -> Self {
        Self {
            epoch: Instant::now(),
            alive: AtomicU64::new(0),
            before_micros: AtomicU64::new(0),
            since: AtomicU64::new(0),
        }
    }
}

impl Busy {
    fn now(&self) -> u64 {
        u64::try_from(self.epoch.elapsed().as_micros()).unwrap_or(u64::MAX - 1)
    }

    pub(super) fn sign_of_life(&self) {
        self.alive.store(self.now(), Ordering::Relaxed);
    }

    /// How long nothing has been heard in the middle of work.
    pub(super) fn silence(&self) -> Duration {
        if self.since.load(Ordering::Relaxed) == 0 {
            return Duration::ZERO;
        }
        let heard = self.alive.load(Ordering::Relaxed);
        Duration::from_micros(self.now().saturating_sub(heard))
    }

    pub(super) fn begin(&self) {
        self.sign_of_life();
        self.since.store(self.now() + 1, Ordering::Relaxed);
    }

    pub(super) fn end(&self) {
        let since = self.since.swap(0, Ordering::Relaxed);
        let took = (self.now() + 1).saturating_sub(since);
        self.before_micros.fetch_add(took, Ordering::Relaxed);
    }

    pub(super) fn total(&self) -> Duration {
        let before = self.before_micros.load(Ordering::Relaxed);
        let current = match self.since.load(Ordering::Relaxed) {
            0 => 0,
            since => (self.now() + 1).saturating_sub(since),
        };
        Duration::from_micros(before + current)
    }
}
