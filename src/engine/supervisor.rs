//! Supervisor of a device, shared by all its lanes: opens it, runs the self-test, counts losses,
//! reopens it with exponential back-off, and gives up in the end.
//!
//! The first lane that needs the device opens it; the others look again every 100 ms whether it is
//! open and whether they still have work. Independent of the tasks that the lanes run.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::panics::message;
use super::self_test;
use super::types::{DeviceFactory, Health, Opened, ReopenPolicy};
use crate::flow::field::Backend;
use crate::metrics::Metrics;
use crate::sync::locked;

/// Whether a lane trusts its device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SelfTest {
    /// Trusted as long as it is there.
    Given,
    /// A task panicked or the device failed: the self-test must pass again.
    Shaken,
}

/// Interval at which a lane looks whether the device is open.
const POLL_INTERVAL: Duration = Duration::from_millis(100);

const WHILE_IDLE: &str = "it went away while it had nothing to do";

/// A lane's share of the open device, for one task.
pub(super) struct DeviceHandle {
    /// Serial number of the opening, so that each loss is counted once.
    opening: u64,
    pub(super) opened: Arc<dyn Opened>,
    pub(super) backend: Arc<dyn Backend>,
}

/// State that the lanes of one device share.
pub(super) struct DeviceSupervisor {
    name: Arc<str>,
    open: DeviceFactory,
    reopening: ReopenPolicy,
    metrics: Arc<Metrics>,
    tell: watch::Sender<Health>,
    /// Whether the device was ever open. Outside `state`, whose holders tell of the health: who reads
    /// the health may ask for it.
    worked: AtomicBool,
    /// Never locked for long: an opening, which may take minutes, is done without the lock.
    state: Mutex<State>,
}

struct State {
    /// Whether a lane is opening the device.
    opening: bool,
    opened: Option<Arc<dyn Opened>>,
    /// The lost device. It is destroyed before the next opening.
    lost: Option<Arc<dyn Opened>>,
    /// Successful openings so far.
    openings: u64,
    /// Failed openings since the last success.
    failures: u32,
    /// Pause after the next failure.
    pause: Duration,
    next_try: Instant,
}

impl DeviceSupervisor {
    pub(super) fn new(
        name: Arc<str>,
        open: DeviceFactory,
        reopening: ReopenPolicy,
        metrics: Arc<Metrics>,
        tell: watch::Sender<Health>,
    ) -> Self {
        Self {
            name,
            open,
            metrics,
            tell,
            worked: AtomicBool::new(false),
            state: Mutex::new(State {
                opening: false,
                opened: None,
                lost: None,
                openings: 0,
                failures: 0,
                pause: reopening.first_pause,
                next_try: Instant::now(),
            }),
            reopening,
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        locked(&self.state)
    }

    /// Whether the device has ever passed its self-test.
    pub(super) fn has_worked(&self) -> bool {
        self.worked.load(Ordering::Relaxed)
    }

    /// Marks the device as lost. The loss is counted once, by the first lane that reports it.
    pub(super) fn mark_lost(&self, handle: &DeviceHandle, reason: &str) {
        let mut state = self.state();
        if state.openings == handle.opening && state.opened.is_some() {
            self.forget(&mut state, reason);
        }
    }

    fn forget(&self, state: &mut State, reason: &str) {
        state.lost = state.opened.take();
        state.next_try = Instant::now();
        self.metrics.device_lost(&self.name);
        tracing::error!(
            device = &*self.name,
            reason,
            "the device was lost: it is opened again"
        );
        self.tell.send_replace(Health::Starting);
    }

    /// Whether the device is lost and no lane has reported it yet.
    pub(super) fn is_lost_unreported(&self) -> bool {
        let state = self.state();
        state.opened.as_ref().is_some_and(|opened| opened.is_lost())
    }

    /// A lane's share of the device, if it is open.
    pub(super) fn share(&self) -> Option<DeviceHandle> {
        let mut state = self.state();
        let opened = state.opened.clone()?;
        if opened.is_lost() {
            self.forget(&mut state, WHILE_IDLE);
            return None;
        }
        Some(DeviceHandle {
            opening: state.openings,
            backend: opened.lane(),
            opened,
        })
    }

    /// Blocks until the device is open, and has passed its self-test again if trust in it is
    /// shaken. Opens it if no other lane does. Returns false as soon as `ended` reports that the
    /// lane has no more work.
    ///
    /// A self-test that finds no memory beside the pairs of other lanes proves no fault, and losing
    /// the device would fail those pairs. In this case the device stays open.
    pub(super) fn open(&self, trust: SelfTest, ended: &mut dyn FnMut() -> bool) -> bool {
        if trust == SelfTest::Shaken
            && let Some(handle) = self.share()
            && let Err(error) = self_test::run(handle.backend.as_ref())
            && !error.is_out_of_memory()
        {
            self.mark_lost(&handle, &error.to_string());
        }
        loop {
            match self.opened() {
                Ok(()) => return true,
                Err(_) if ended() => return false,
                Err(wait) => thread::sleep(wait.min(POLL_INTERVAL)),
            }
        }
    }

    /// Opens the device if it is not open and no other lane opens it. The error is the time until the
    /// next look.
    fn opened(&self) -> Result<(), Duration> {
        let mut state = self.state();
        let now = Instant::now();
        match &state.opened {
            Some(opened) if opened.is_lost() => self.forget(&mut state, WHILE_IDLE),
            Some(_) => return Ok(()),
            None => {}
        }
        if state.opening {
            return Err(POLL_INTERVAL);
        }
        if now < state.next_try {
            return Err(state.next_try - now);
        }
        state.opening = true;
        let lost = state.lost.take();
        drop(state);
        if let Some(lost) = lost {
            self.give_up(lost);
        }
        // With a panic no other lane would ever open the device.
        let tried = catch_unwind(AssertUnwindSafe(|| self.opened_and_tried()));
        let tried = tried.unwrap_or_else(|panic| Err(message(panic.as_ref())));
        let mut state = self.state();
        state.opening = false;
        let reason = match tried {
            Ok(opened) => {
                state.opened = Some(opened);
                state.openings += 1;
                state.failures = 0;
                state.pause = self.reopening.first_pause;
                self.worked.store(true, Ordering::Relaxed);
                self.tell.send_replace(Health::Ready);
                return Ok(());
            }
            Err(reason) => reason,
        };
        state.failures += 1;
        let pause = state.pause;
        state.next_try = Instant::now() + pause;
        state.pause = (pause * 4).min(self.reopening.longest_pause);
        tracing::error!(
            device = &*self.name,
            %reason,
            tries = state.failures,
            "the device cannot be used"
        );
        let given_up = self.has_worked() && state.failures >= self.reopening.tries;
        let health = if given_up {
            Health::Gone
        } else {
            Health::Broken
        };
        self.tell.send_replace(health(reason));
        Err(pause)
    }

    /// Frees the resources of a lost device, even if other lanes still use it: reopening needs
    /// them. Not called while a lane has a result to send, since a dead driver may take long or
    /// panic.
    fn give_up(&self, lost: Arc<dyn Opened>) {
        let freed = catch_unwind(AssertUnwindSafe(move || lost.destroy()));
        if let Err(panic) = freed {
            let panic = message(panic.as_ref());
            tracing::warn!(device = &*self.name, panic, "the lost device was not freed");
        }
    }

    fn opened_and_tried(&self) -> Result<Arc<dyn Opened>, String> {
        let opened = self_test::opened(&self.open)?;
        tracing::info!(device = &*self.name, is = opened.lane().name(), "ready");
        Ok(opened)
    }
}
