//! The thread of one lane: runs one task at a time and catches its panics.

use std::panic::{AssertUnwindSafe, catch_unwind};

use tokio::sync::mpsc::error::TryRecvError;
use tokio::sync::{mpsc, oneshot};

use super::liveness::{Liveness, MonitoredControl};
use super::panics::message;
use super::supervisor::{DeviceHandle, DeviceSupervisor, SelfTest};
use super::types::{EngineError, Work};
use crate::flow::field::{Backend, BackendError};
use crate::flow::{self, Estimate, FlowError, Problem};

/// A message to a lane's thread.
pub(super) enum Command {
    /// Run a task and send its result back.
    Do(Box<dyn Task>),
    /// Check that the device is still there.
    Look,
}

/// A task for a device.
pub(super) trait Task: Send {
    /// Runs the task and sends its result. Returns whether the device is still trusted.
    fn run(
        self: Box<Self>,
        supervisor: &DeviceSupervisor,
        handle: &DeviceHandle,
        liveness: &Liveness,
    ) -> SelfTest;
    /// Returns the task unrun, so that another device can run it.
    fn reject(self: Box<Self>);
}

/// Work, and the channel for its result.
pub(super) struct Request<W, T> {
    pub(super) work: W,
    pub(super) reply: oneshot::Sender<Result<T, EngineError>>,
}

impl<W, T> Task for Request<W, T>
where
    W: FnOnce(&dyn Backend, &Liveness) -> Result<T, EngineError> + Send,
    T: Send,
{
    fn run(
        self: Box<Self>,
        supervisor: &DeviceSupervisor,
        handle: &DeviceHandle,
        liveness: &Liveness,
    ) -> SelfTest {
        let Self { work, reply } = *self;
        liveness.begin();
        let done = catch_unwind(AssertUnwindSafe(|| work(handle.backend.as_ref(), liveness)));
        liveness.end();
        let (answer, trust) = classified(supervisor, handle, done);
        let _nobody_waits_is_fine = reply.send(answer);
        trust
    }

    fn reject(self: Box<Self>) {
        let answer = Err(EngineError::Broken("it is being opened again".to_owned()));
        let _nobody_waits_is_fine = self.reply.send(answer);
    }
}

/// Runs tasks until the channel closes. Between two tasks the thread holds no reference to the
/// device.
pub(super) fn run(
    supervisor: &DeviceSupervisor,
    mut inbox: mpsc::Receiver<Command>,
    liveness: &Liveness,
) {
    let mut trust = SelfTest::Given;
    while supervisor.open(trust, &mut || rejected(&mut inbox)) {
        let task = match inbox.blocking_recv() {
            Some(Command::Do(task)) => task,
            Some(Command::Look) => continue,
            None => return,
        };
        let Some(handle) = supervisor.share() else {
            trust = SelfTest::Given;
            task.reject();
            continue;
        };
        trust = task.run(supervisor, &handle, liveness);
        disarm(handle);
    }
}

/// Returns the tasks that arrive while the device cannot be opened, so that another device can run
/// them. True if the channel is closed.
fn rejected(inbox: &mut mpsc::Receiver<Command>) -> bool {
    loop {
        match inbox.try_recv() {
            Ok(Command::Do(task)) => task.reject(),
            Ok(Command::Look) => {}
            Err(TryRecvError::Empty) => return false,
            Err(TryRecvError::Disconnected) => return true,
        }
    }
}

/// Drops a lane's share of the device, after the result is sent. Dropping the last handle of a dead
/// GPU may take long or panic.
fn disarm(handle: DeviceHandle) {
    if let Err(panic) = catch_unwind(AssertUnwindSafe(move || drop(handle))) {
        let panic = message(panic.as_ref());
        tracing::warn!(panic, "a device that was let go of panicked");
    }
}

/// Derives the result of a task and the trust in the device. Every result of a lost device is
/// discarded, since it may be stale.
fn classified<T>(
    supervisor: &DeviceSupervisor,
    handle: &DeviceHandle,
    done: std::thread::Result<Result<T, EngineError>>,
) -> (Result<T, EngineError>, SelfTest) {
    let (answer, trust) = match done {
        Ok(Ok(found)) => (Ok(found), SelfTest::Given),
        Ok(Err(EngineError::Flow(FlowError::Backend(BackendError::Lost(reason))))) => {
            (Err(EngineError::Lost(reason)), SelfTest::Given)
        }
        Ok(Err(error)) => {
            let trust = match error {
                EngineError::Flow(FlowError::Backend(BackendError::Device(_))) => SelfTest::Shaken,
                _ => SelfTest::Given,
            };
            (Err(error), trust)
        }
        Err(panic) => {
            let message = message(panic.as_ref());
            (Err(EngineError::Panicked(message)), SelfTest::Shaken)
        }
    };
    match (answer, handle.opened.is_lost()) {
        (Err(EngineError::Lost(reason)), _) => {
            supervisor.mark_lost(handle, &reason);
            (Err(EngineError::Lost(reason)), trust)
        }
        // The job is cancelled anyway, so the loss does not count against it.
        (Err(EngineError::Flow(FlowError::Cancelled)), true) => {
            supervisor.mark_lost(handle, "it went away under work");
            (Err(FlowError::Cancelled.into()), SelfTest::Given)
        }
        (answer, true) => {
            let reason = match answer {
                Ok(_) => "it went away under work".to_owned(),
                Err(error) => error.to_string(),
            };
            supervisor.mark_lost(handle, &reason);
            (Err(EngineError::Lost(reason)), SelfTest::Given)
        }
        (answer, false) => (answer, trust),
    }
}

/// Estimates the flow of one pair, resuming from its snapshot if that is usable.
pub(super) fn estimate(
    backend: &dyn Backend,
    work: Work,
    liveness: &Liveness,
) -> Result<Estimate, FlowError> {
    let control = MonitoredControl {
        control: work.control.as_ref(),
        liveness,
    };
    let ground = work.ground.as_ref();
    let neighbors = work.neighbors.iter();
    let neighbors: Vec<_> = neighbors
        .map(|(sweep, at)| sweep.as_neighbor(*at))
        .collect();
    let problem = Problem {
        source: &work.source,
        target: &work.target,
        ground: ground.map(|[source, target]| [source.as_slice(), target.as_slice()]),
        times: None,
        before: work.before.as_ref(),
        neighbors: &neighbors,
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
