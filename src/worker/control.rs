//! Controls of the running work of a job: heartbeat, deadline, cancellation and snapshots.
//!
//! Called from the device's thread before every iteration, so calls must be cheap. They do not
//! block, except for the last snapshot of a shutdown.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use crate::flow::{Control, Interrupt, Progress};
use crate::job::JobProgress;
use crate::queue::{LeaseHeartbeat, Signal};
use crate::sync::locked;

/// The control of one attempt at a pair.
pub(super) struct JobControl {
    began: Instant,
    heartbeat: LeaseHeartbeat,
    deadline: Option<Instant>,
    snapshot_interval: Duration,
    last_snapshot: Mutex<Instant>,
    release: CancellationToken,
    put_down: AtomicBool,
    snapshots: mpsc::Sender<Vec<u8>>,
}

impl JobControl {
    pub(super) fn new(
        heartbeat: LeaseHeartbeat,
        deadline: Option<Instant>,
        snapshot_interval: Duration,
        release: CancellationToken,
        snapshots: mpsc::Sender<Vec<u8>>,
    ) -> Self {
        let began = Instant::now();
        Self {
            began,
            heartbeat,
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
        let gone = self.heartbeat.beat(None) != Signal::Continue;
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
        self.heartbeat.beat(Some(JobProgress {
            done: count(progress.done),
            total: count(progress.total),
            loss: progress.loss,
        }));
    }

    fn snapshot_due(&self) -> bool {
        if self.release.is_cancelled() {
            return !self.put_down.load(Ordering::Relaxed);
        }
        let last = locked(&self.last_snapshot);
        last.elapsed() >= self.snapshot_interval
    }

    fn snapshot(&self, bytes: Vec<u8>) {
        let releasing = self.release.is_cancelled();
        *locked(&self.last_snapshot) = Instant::now();
        if releasing {
            // The last snapshot is worth blocking for: the thread has no other work.
            let _nobody_keeps_it_is_fine = self.snapshots.blocking_send(bytes);
            self.put_down.store(true, Ordering::Relaxed);
        } else {
            // It may be skipped while the previous one is being written.
            let _skipped_is_fine = self.snapshots.try_send(bytes);
        }
    }
}

/// The control of a densification. It takes no snapshots, so it stops at once when the worker
/// releases its job.
pub(super) struct DenseControl {
    /// Sends heartbeats.
    heartbeat: LeaseHeartbeat,
    release: CancellationToken,
}

impl DenseControl {
    pub(super) fn new(heartbeat: LeaseHeartbeat, release: CancellationToken) -> Self {
        Self { heartbeat, release }
    }
}

impl Control for DenseControl {
    fn interrupt(&self) -> Option<Interrupt> {
        let gone = self.heartbeat.beat(None) != Signal::Continue;
        (gone || self.release.is_cancelled()).then_some(Interrupt::Cancelled)
    }
}
