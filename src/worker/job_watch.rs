//! How a job looks in on its optimization: its lease, its deadline, its snapshots.
//!
//! Called from the device's thread before every iteration, so it must be cheap and never wait.

use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::flow::{Control, Interrupt, Progress, Snapshot};
use crate::job::JobProgress;
use crate::queue::{Pulse, Signal};

/// Looks in for one attempt.
pub(super) struct JobControl {
    began: Instant,
    pulse: Pulse,
    deadline: Option<Instant>,
    snapshot_interval: Duration,
    last_snapshot: Mutex<Instant>,
    release: CancellationToken,
    put_down: AtomicBool,
    snapshots: mpsc::Sender<Snapshot>,
}

impl JobControl {
    pub(super) fn new(
        pulse: Pulse,
        deadline: Option<Instant>,
        snapshot_interval: Duration,
        release: CancellationToken,
        snapshots: mpsc::Sender<Snapshot>,
    ) -> Self {
        let began = Instant::now();
        Self {
            began,
            pulse,
            deadline,
            snapshot_interval,
            last_snapshot: Mutex::new(began),
            release,
            put_down: AtomicBool::new(false),
            snapshots,
        }
    }
}

impl Control for JobControl {
    fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    fn seconds_left(&self) -> Option<f64> {
        let deadline = self.deadline?;
        Some(
            deadline
                .saturating_duration_since(Instant::now())
                .as_secs_f64(),
        )
    }

    fn interrupt(&self) -> Option<Interrupt> {
        let gone = self.pulse.beat(None) != Signal::Continue;
        let put_down = self.put_down.load(Ordering::Relaxed);
        if gone || put_down {
            return Some(Interrupt::Cancelled);
        }
        let late = self
            .deadline
            .is_some_and(|deadline| deadline <= Instant::now());
        late.then_some(Interrupt::Deadline)
    }

    fn progress(&self, progress: Progress) {
        let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
        self.pulse.beat(Some(JobProgress {
            iteration: count(progress.iteration),
            max_iterations: count(progress.max_iterations),
            loss: progress.loss,
        }));
    }

    fn snapshot_due(&self) -> bool {
        if self.release.is_cancelled() {
            return !self.put_down.load(Ordering::Relaxed);
        }
        let last = self
            .last_snapshot
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        last.elapsed() >= self.snapshot_interval
    }

    fn snapshot(&self, snapshot: Snapshot) {
        let releasing = self.release.is_cancelled();
        *self
            .last_snapshot
            .lock()
            .unwrap_or_else(PoisonError::into_inner) = Instant::now();
        if releasing {
            // The last one is worth waiting for: the thread has nothing else to do.
            let _nobody_keeps_it_is_fine = self.snapshots.blocking_send(snapshot);
            self.put_down.store(true, Ordering::Relaxed);
        } else {
            // While the one before is being written, this one may be skipped.
            let _skipped_is_fine = self.snapshots.try_send(snapshot);
        }
    }
}

/// Looks in while sweeps are carried into one frame: there is nothing to put down half-way, so that
/// a worker that is to stop lets go at once.
pub(super) struct DenseControl {
    pulse: Pulse,
    release: CancellationToken,
}

impl DenseControl {
    pub(super) fn new(pulse: Pulse, release: CancellationToken) -> Self {
        Self { pulse, release }
    }
}

impl Control for DenseControl {
    fn interrupt(&self) -> Option<Interrupt> {
        let gone = self.pulse.beat(None) != Signal::Continue;
        (gone || self.release.is_cancelled()).then_some(Interrupt::Cancelled)
    }
}
