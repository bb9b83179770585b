//! One lane's thread: takes a pair at a time, and never lets a panic out.
//!
//! It must not know how a device is opened, only that it has to ask for it again.

use std::panic::{AssertUnwindSafe, catch_unwind};

use tokio::sync::mpsc::error::TryRecvError;
use tokio::sync::{mpsc, oneshot};

use super::busy::Busy;
use super::hold::{Held, Hold};
use super::{EngineError, Work};
use crate::flow::field::{Backend, BackendError};
use crate::flow::{
    self, Control, Estimate, FlowError, Interrupt, NeighborSweep, Problem, Progress, Snapshot,
    Sweep,
};

/// What a lane is told.
pub(super) enum Command {
    /// Do something, and tell whoever waits for it.
    Do(Box<dyn Task>),
    /// See whether the device is still there.
    Look,
}

/// Something for a device.
pub(super) trait Task: Send {
    /// Does it, and answers.
    fn run(self: Box<Self>, hold: &Hold, held: &Held, busy: &Busy) -> Trust;
    /// Gives it back: another device may do it meanwhile.
    fn turn_away(self: Box<Self>);
}

/// Work, and where its answer goes.
pub(super) struct Asked<W, T> {
    pub(super) work: W,
    pub(super) reply: oneshot::Sender<Result<T, EngineError>>,
}

impl<W, T> Task for Asked<W, T>
where
    W: FnOnce(&dyn Backend, &Busy) -> Result<T, EngineError> + Send,
    T: Send,
{
    fn run(self: Box<Self>, hold: &Hold, held: &Held, busy: &Busy) -> Trust {
        let Self { work, reply } = *self;
        busy.begin();
        let done = catch_unwind(AssertUnwindSafe(|| work(held.backend.as_ref(), busy)));
        busy.end();
        let (answer, trust) = judged(hold, held, done);
        let _nobody_waits_is_fine = reply.send(answer);
        trust
    }

    fn turn_away(self: Box<Self>) {
        let answer = Err(EngineError::Broken("it is being opened again".to_owned()));
        let _nobody_waits_is_fine = self.reply.send(answer);
    }
}

/// Whether a lane trusts its device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Trust {
    /// As long as it is there.
    Given,
    /// Something broke: it must pass its trial again.
    Shaken,
}

/// Works until nobody has work any more. Between two pairs it holds nothing of the device.
pub(super) fn run(hold: &Hold, mut inbox: mpsc::Receiver<Command>, busy: &Busy) {
    let mut trust = Trust::Given;
    while hold.open(trust, &mut || turned_away(&mut inbox)) {
        let task = match inbox.blocking_recv() {
            Some(Command::Do(task)) => task,
            Some(Command::Look) => continue,
            None => return,
        };
        let Some(held) = hold.share() else {
            trust = Trust::Given;
            task.turn_away();
            continue;
        };
        trust = task.run(hold, &held, busy);
        let_go(held);
    }
}

/// Gives back what comes while the device cannot be opened: another one may do it meanwhile. Says
/// whether nothing will come any more.
fn turned_away(inbox: &mut mpsc::Receiver<Command>) -> bool {
    loop {
        match inbox.try_recv() {
            Ok(Command::Do(task)) => task.turn_away(),
            Ok(Command::Look) => {}
            Err(TryRecvError::Empty) => return false,
            Err(TryRecvError::Disconnected) => return true,
        }
    }
}

/// Drops a lane's share of the device, after the answer: the last handle on a dead card may take
/// its time, or panic.
fn let_go(held: Held) {
    if let Err(panic) = catch_unwind(AssertUnwindSafe(move || drop(held))) {
        let panic = message(panic.as_ref());
        tracing::warn!(panic, "a device that was let go of panicked");
    }
}

/// What an attempt says about the pair, and what about the device. Whatever comes from a device
/// that is gone counts for nothing: it may be stale.
fn judged<T>(
    hold: &Hold,
    held: &Held,
    done: std::thread::Result<Result<T, EngineError>>,
) -> (Result<T, EngineError>, Trust) {
    let (answer, trust) = match done {
        Ok(Ok(found)) => (Ok(found), Trust::Given),
        Ok(Err(EngineError::Flow(FlowError::Backend(BackendError::Lost(reason))))) => {
            (Err(EngineError::Lost(reason)), Trust::Given)
        }
        Ok(Err(error)) => {
            let trust = match error {
                EngineError::Flow(FlowError::Backend(BackendError::Device(_))) => Trust::Shaken,
                _ => Trust::Given,
            };
            (Err(error), trust)
        }
        Err(panic) => {
            let message = message(panic.as_ref());
            (Err(EngineError::Panicked(message)), Trust::Shaken)
        }
    };
    match (answer, held.opened.is_lost()) {
        (Err(EngineError::Lost(reason)), _) => {
            hold.lose(held, &reason);
            (Err(EngineError::Lost(reason)), trust)
        }
        // Nobody wants it any more, lost or not.
        (Err(EngineError::Flow(FlowError::Cancelled)), true) => {
            hold.lose(held, "it went away under work");
            (Err(FlowError::Cancelled.into()), Trust::Given)
        }
        (answer, true) => {
            let reason = match answer {
                Ok(_) => "it went away under work".to_owned(),
                Err(error) => error.to_string(),
            };
            hold.lose(held, &reason);
            (Err(EngineError::Lost(reason)), Trust::Given)
        }
        (answer, false) => (answer, trust),
    }
}

/// Passes everything on, and hears the signs of life.
pub(super) struct Heard<'a> {
    pub(super) control: &'a dyn Control,
    pub(super) busy: &'a Busy,
}

impl Control for Heard<'_> {
    fn seconds(&self) -> f64 {
        self.control.seconds()
    }

    fn seconds_left(&self) -> Option<f64> {
        self.control.seconds_left()
    }

    fn interrupt(&self) -> Option<Interrupt> {
        self.busy.sign_of_life();
        self.control.interrupt()
    }

    fn progress(&self, progress: Progress) {
        self.control.progress(progress);
    }

    fn snapshot_due(&self) -> bool {
        self.control.snapshot_due()
    }

    fn snapshot(&self, snapshot: Snapshot) {
        self.control.snapshot(snapshot);
    }
}

/// Estimates one pair's flow, from its snapshot where that is of use.
pub(super) fn solve(backend: &dyn Backend, work: Work, busy: &Busy) -> Result<Estimate, FlowError> {
    let control = Heard {
        control: work.control.as_ref(),
        busy,
    };
    let ground = work.ground.as_ref();
    let around = work.around.iter().map(|(Sweep { points, ground }, at)| {
        let ground = ground.as_deref();
        NeighborSweep {
            points,
            ground,
            at: *at,
        }
    });
    let around: Vec<NeighborSweep<'_>> = around.collect();
    let problem = Problem {
        source: &work.source,
        target: &work.target,
        ground: ground.map(|[source, target]| [source.as_slice(), target.as_slice()]),
        before: work.before.as_ref(),
        around: &around,
    };
    if let Some(snapshot) = work.snapshot {
        match flow::resume(backend, &problem, &work.options, snapshot, &control) {
            Err(FlowError::Snapshot(error)) => {
                tracing::warn!(%error, "a snapshot is of no use: the job starts afresh");
            }
            resumed => return resumed,
        }
    }
    flow::estimate(backend, &problem, &work.options, &control)
}

/// What a panic said.
pub(super) fn message(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
    text.unwrap_or_else(|| "without a word".to_owned())
}
