//! Liveness of a lane: its working time and its last heartbeat.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use crate::flow::Control;
use crate::flow::Interrupt;
use crate::flow::Progress;

/// Working time of a lane, including the current task, and its last heartbeat. All times are
/// microseconds after `epoch`.
#[derive(Debug)]
pub(super) struct Liveness {
    epoch: Instant,
    /// Time of the last heartbeat.
    alive: AtomicU64,
    /// Working time of the finished tasks, microseconds.
    before_micros: AtomicU64,
    /// Start time of the current task plus one; zero when idle.
    since: AtomicU64,
}

impl Default for Liveness {
    fn default() -> Self {
        Self {
            epoch: Instant::now(),
            alive: AtomicU64::new(0),
            before_micros: AtomicU64::new(0),
            since: AtomicU64::new(0),
        }
    }
}

impl Liveness {
    fn now(&self) -> u64 {
        u64::try_from(self.epoch.elapsed().as_micros()).unwrap_or(u64::MAX - 1)
    }

    /// Records a heartbeat.
    pub(super) fn heartbeat(&self) {
        self.alive.store(self.now(), Ordering::Relaxed);
    }

    /// Time since the last heartbeat during work; zero when idle.
    pub(super) fn since_heartbeat(&self) -> Duration {
        if self.since.load(Ordering::Relaxed) == 0 {
            return Duration::ZERO;
        }
        let heard = self.alive.load(Ordering::Relaxed);
        Duration::from_micros(self.now().saturating_sub(heard))
    }

    pub(super) fn begin(&self) {
        self.heartbeat();
        self.since.store(self.now() + 1, Ordering::Relaxed);
    }

    pub(super) fn end(&self) {
        let since = self.since.swap(0, Ordering::Relaxed);
        let took = (self.now() + 1).saturating_sub(since);
        self.before_micros.fetch_add(took, Ordering::Relaxed);
    }

    /// Total working time, including the current task.
    pub(super) fn total(&self) -> Duration {
        let before = self.before_micros.load(Ordering::Relaxed);
        let current = match self.since.load(Ordering::Relaxed) {
            0 => 0,
            since => (self.now() + 1).saturating_sub(since),
        };
        Duration::from_micros(before + current)
    }
}

/// Forwards to another control, and counts every check for an interrupt as a heartbeat.
pub(super) struct MonitoredControl<'a> {
    pub(super) control: &'a dyn Control,
    pub(super) liveness: &'a Liveness,
}

impl Control for MonitoredControl<'_> {
    fn seconds(&self) -> f64 {
        self.control.seconds()
    }

    fn seconds_left(&self) -> Option<f64> {
        self.control.seconds_left()
    }

    fn interrupt(&self) -> Option<Interrupt> {
        self.liveness.heartbeat();
        self.control.interrupt()
    }

    fn progress(&self, progress: Progress) {
        self.control.progress(progress);
    }

    fn snapshot_due(&self) -> bool {
        self.control.snapshot_due()
    }

    fn snapshot(&self, bytes: Vec<u8>) {
        self.control.snapshot(bytes);
    }
}
