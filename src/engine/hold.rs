//! The hold that all lanes of a device have on it: opened once for all of them, tried, lost once,
//! opened again with growing pauses, and in the end given up.
//!
//! The lane that comes first opens; the others wait for it. It must not know what lanes do.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::lane::{Trust, message};
use super::{Health, Opened, Opener, Reopening, trial};
use crate::flow::field::Backend;
use crate::metrics::Metrics;

const WHILE_IDLE: &str = "it went away while it had nothing to do";

/// A lane's share of the device, for one pair.
pub(super) struct Held {
    opening: u64,
    pub(super) opened: Arc<dyn Opened>,
    pub(super) backend: Arc<dyn Backend>,
}

/// What the lanes of one device share.
pub(super) struct Hold {
    name: Arc<str>,
    open: Opener,
    reopening: Reopening,
    metrics: Arc<Metrics>,
    tell: watch::Sender<Health>,
    /// Whether it was ever open. Beside the state, which is locked as long as an opening takes.
    worked: AtomicBool,
    state: Mutex<State>,
}

struct State {
    opened: Option<Arc<dyn Opened>>,
    /// What was lost, until it is given up before the next opening.
    lost: Option<Arc<dyn Opened>>,
    openings: u64,
    /// Openings that failed since the last one that did not.
    failures: u32,
    pause: Duration,
    next_try: Instant,
}

impl Hold {
    pub(super) fn new(
        name: Arc<str>,
        open: Opener,
        reopening: Reopening,
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
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether the device has ever passed its trial.
    pub(super) fn has_worked(&self) -> bool {
        self.worked.load(Ordering::Relaxed)
    }

    /// The device is gone: it is counted once, whichever lane says so first.
    pub(super) fn lose(&self, held: &Held, reason: &str) {
        let mut state = self.state();
        if state.openings == held.opening && state.opened.is_some() {
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

    /// Whether the device is gone and nobody has said so yet.
    pub(super) fn is_lost_in_silence(&self) -> bool {
        match self.state.try_lock() {
            Ok(state) => state.opened.as_ref().is_some_and(|opened| opened.is_lost()),
            // It is being opened.
            Err(_) => false,
        }
    }

    /// A lane's share of the device, while it is open.
    pub(super) fn share(&self) -> Option<Held> {
        let mut state = self.state();
        let opened = state.opened.clone()?;
        if opened.is_lost() {
            self.forget(&mut state, WHILE_IDLE);
            return None;
        }
        Some(Held {
            opening: state.openings,
            backend: opened.lane(),
            opened,
        })
    }

    /// Comes back when the device is open, and has passed its trial again where trust in it is
    /// shaken; opens it if nobody else does. False where `ended` says that the lane has no more
    /// work.
    ///
    /// A trial that finds no room beside the pairs of other lanes says nothing about the device,
    /// and losing it would cost them theirs: it is left alone.
    pub(super) fn open(&self, trust: Trust, ended: &mut dyn FnMut() -> bool) -> bool {
        const LOOK: Duration = Duration::from_millis(100);
        if trust == Trust::Shaken
            && let Some(held) = self.share()
            && let Err(error) = trial::run(held.backend.as_ref())
            && !error.is_lack_of_room()
        {
            self.lose(&held, &error.to_string());
        }
        loop {
            match self.opened() {
                Ok(()) => return true,
                Err(_) if ended() => return false,
                Err(wait) => thread::sleep(wait.min(LOOK)),
            }
        }
    }

    /// Opens the device, where it is not; or says how long to wait before that.
    fn opened(&self) -> Result<(), Duration> {
        let mut state = self.state();
        let now = Instant::now();
        match &state.opened {
            Some(opened) if opened.is_lost() => self.forget(&mut state, WHILE_IDLE),
            Some(_) => return Ok(()),
            None => {}
        }
        if now < state.next_try {
            return Err(state.next_try - now);
        }
        if let Some(lost) = state.lost.take() {
            self.give_up(lost);
        }
        let reason = match self.opened_and_tried() {
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

    /// Frees what a lost device holds, which is needed to open it again, even where other lanes
    /// are still at work on it. Not while a lane has an answer to give: a dead driver may take its
    /// time, or panic.
    fn give_up(&self, lost: Arc<dyn Opened>) {
        let freed = catch_unwind(AssertUnwindSafe(move || lost.destroy()));
        if let Err(panic) = freed {
            let panic = message(panic.as_ref());
            tracing::warn!(device = &*self.name, panic, "the lost device was not freed");
        }
    }

    fn opened_and_tried(&self) -> Result<Arc<dyn Opened>, String> {
        let opened = trial::opened(&self.open)?;
        tracing::info!(device = &*self.name, is = opened.lane().name(), "ready");
        Ok(opened)
    }
}
