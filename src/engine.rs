//! A device, and the threads that work on it: its lanes.
//!
//! Each lane takes one pair at a time; the device is opened once for all
//! of them and has one health. A panic costs the pair that it happened in, a lost device the pairs
//! that were on it: then it is opened again and must pass its trial. It must not know queues,
//! stores or doors.

mod busy;
mod dense;
mod hold;
mod lane;
mod trial;

#[cfg(test)]
pub(crate) mod cards;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};

use self::busy::Busy;
pub use self::dense::{Densification, Densified};
use self::hold::Hold;
use self::lane::{Asked, Command};
use crate::flow::densify::DensifyError;
use crate::flow::field::{Backend, BackendError};
use crate::flow::{Control, Estimate, FlowError, MotionField, Options, Point, Snapshot, Sweep};
use crate::job::DeviceKind;
use crate::metrics::Metrics;

/// Solves a small pair whose flow is known.
///
/// # Errors
/// What is wrong with the device.
pub fn try_out(backend: &dyn Backend) -> Result<(), String> {
    trial::run(backend).map_err(|error| error.to_string())
}

/// Opens a device, tries it, and gives it up again.
///
/// # Errors
/// What is wrong with it.
pub fn try_opening(open: &Opener) -> Result<(), String> {
    trial::opened(open).map(|opened| opened.destroy())
}

/// One pair for a device.
pub struct Work {
    /// N points, metres.
    pub source: Vec<Point>,
    /// M points, metres.
    pub target: Vec<Point>,
    /// N and M flags: which points are ground, where that is known.
    pub ground: Option<[Vec<bool>; 2]>,
    /// The field of the pair before, where it is one of a chain.
    pub before: Option<MotionField>,
    /// Other sweeps of its sequence, and when each was taken: in gaps of the pair after the source.
    pub around: Vec<(Sweep, i8)>,
    /// How the flow is found.
    pub options: Options,
    /// Where an earlier attempt was put down.
    pub snapshot: Option<Snapshot>,
    /// Looks in on the optimization.
    pub control: Arc<dyn Control + Send + Sync>,
}

/// What a device can do now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Health {
    /// It is being opened, or tried.
    Starting,
    /// It has passed its trial.
    Ready,
    /// It cannot be used; it is tried again.
    Broken(String),
    /// It has worked and does not come back, however often it is opened. It is still tried, but
    /// only a fresh process may help.
    Gone(String),
}

/// Why a device gave no flow.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The solver refused or failed.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// The sweeps and fields do not make a cloud.
    #[error(transparent)]
    Densify(DensifyError),
    /// The solver panicked; the device is tried again.
    #[error("the solver panicked: {0}")]
    Panicked(String),
    /// The device went away under work; it is opened again.
    #[error("the device was lost: {0}")]
    Lost(String),
    /// The device could not even begin.
    #[error("the device cannot be used: {0}")]
    Broken(String),
}

/// A device that is open.
pub trait Opened: Send + Sync {
    /// A backend for one pair; those of several lanes work at the same time.
    fn lane(&self) -> Arc<dyn Backend>;

    /// Whether the device is gone, so that nothing that comes from it counts.
    fn is_lost(&self) -> bool;

    /// Gives the device up, its memory included: whatever still runs on it fails as lost.
    fn destroy(&self);
}

/// Opens a device; called again when it was lost.
pub type Opener = Box<dyn Fn() -> Result<Box<dyn Opened>, BackendError> + Send + Sync>;

/// How a device that cannot be opened is tried again.
#[derive(Clone, Copy, Debug)]
pub struct Reopening {
    /// Before the second try; four times as long before each one after it.
    pub first_pause: Duration,
    /// No pause is longer.
    pub longest_pause: Duration,
    /// Tries without success after which a device that has worked is given up.
    pub tries: u32,
}

impl Default for Reopening {
    /// Six tries in about three quarters of a minute: longer than a driver takes to reset a card.
    fn default() -> Self {
        Self {
            first_pause: Duration::from_millis(200),
            longest_pause: Duration::from_secs(30),
            tries: 6,
        }
    }
}

/// What a device is, before it is opened.
pub struct DeviceOptions {
    /// Its name in metrics and logs.
    pub name: String,
    /// What it is.
    pub kind: DeviceKind,
    /// Pairs that it works on at the same time.
    pub lanes: usize,
    /// How it is opened.
    pub open: Opener,
    /// How it is tried again.
    pub reopening: Reopening,
}

/// The way to one lane's thread.
struct LaneEnd {
    commands: mpsc::Sender<Command>,
    busy: Arc<Busy>,
}

/// The way to a device.
#[derive(Clone)]
pub struct Device {
    name: Arc<str>,
    kind: DeviceKind,
    health: watch::Receiver<Health>,
    hold: Arc<Hold>,
    lanes: Arc<[LaneEnd]>,
}

/// One of the pairs that a device can work on at a time.
#[derive(Clone)]
pub struct Lane {
    device: Device,
    place: usize,
}

impl Device {
    /// Starts the lanes' threads; the first of them opens the device.
    ///
    /// # Errors
    /// Where a thread cannot be started.
    pub fn start(options: DeviceOptions, metrics: &Arc<Metrics>) -> std::io::Result<Self> {
        let (tell, health) = watch::channel(Health::Starting);
        let name: Arc<str> = Arc::from(options.name);
        let hold = Arc::new(Hold::new(
            Arc::clone(&name),
            options.open,
            options.reopening,
            Arc::clone(metrics),
            tell,
        ));
        let mut lanes = Vec::new();
        for place in 0..options.lanes.max(1) {
            let (commands, inbox) = mpsc::channel(1);
            let busy = Arc::new(Busy::default());
            let (lane_hold, lane_busy) = (Arc::clone(&hold), Arc::clone(&busy));
            thread::Builder::new()
                .name(format!("device {name} {place}"))
                .spawn(move || lane::run(&lane_hold, inbox, &lane_busy))?;
            lanes.push(LaneEnd { commands, busy });
        }
        metrics.device_lanes(&name, lanes.len());
        Ok(Self {
            name,
            kind: options.kind,
            health,
            hold,
            lanes: lanes.into(),
        })
    }

    /// The device's name in metrics and logs.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// What the device is.
    pub fn kind(&self) -> DeviceKind {
        self.kind
    }

    /// The device's health, now and as it changes.
    pub fn health(&self) -> watch::Receiver<Health> {
        self.health.clone()
    }

    /// Whether it works, or may without anybody's help: one that was lost a moment ago comes back
    /// as a rule, one that never worked does not.
    pub fn may_work(&self) -> bool {
        match &*self.health.borrow() {
            Health::Starting | Health::Ready => true,
            Health::Broken(_) => self.hold.has_worked(),
            Health::Gone(_) => false,
        }
    }

    /// Its lanes, each for a worker of its own.
    pub fn lanes(&self) -> impl ExactSizeIterator<Item = Lane> + '_ {
        (0..self.lanes.len()).map(|place| Lane {
            device: self.clone(),
            place,
        })
    }

    /// What stands in the way of work; nothing where the device has passed its trial and every
    /// lane that works has given a sign of life a moment ago.
    pub fn obstacle(&self) -> Option<String> {
        if self.lanes().all(|lane| lane.has_ended()) {
            return Some(format!("{} has no thread any more", self.name));
        }
        match &*self.health.borrow() {
            Health::Starting => Some(format!("{} is being tried", self.name)),
            Health::Broken(reason) | Health::Gone(reason) => {
                Some(format!("{}: {reason}", self.name))
            }
            Health::Ready => {
                let silences = self.lanes.iter().map(|lane| lane.busy.silence());
                let silence = silences.max().unwrap_or_default();
                (silence > LONGEST_SILENCE).then(|| {
                    format!(
                        "{} gave no sign of life for {} s",
                        self.name,
                        silence.as_secs()
                    )
                })
            }
        }
    }

    /// Has a device opened again that went away while it had nothing to do; whoever works on it
    /// finds out by itself.
    pub fn look(&self) {
        if self.hold.is_lost_in_silence() {
            let _a_busy_lane_finds_out = self.lanes[0].commands.try_send(Command::Look);
        }
    }

    /// How long its lanes have worked in all, together.
    pub fn busy(&self) -> Duration {
        self.lanes.iter().map(|lane| lane.busy.total()).sum()
    }
}

impl Lane {
    /// The device that it is a lane of.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// What the device is.
    pub fn kind(&self) -> DeviceKind {
        self.device.kind
    }

    /// Whether its thread is gone, by a panic that it should have caught: it will never work again.
    pub fn has_ended(&self) -> bool {
        self.device.lanes[self.place].commands.is_closed()
    }

    /// Estimates one pair's flow.
    ///
    /// # Errors
    /// [`EngineError`]; the device is ready for the next pair, or says otherwise in its health.
    pub async fn solve(&self, work: Work) -> Result<Estimate, EngineError> {
        self.run(move |backend, busy| Ok(lane::solve(backend, work, busy)?))
            .await
    }

    /// Carries a sequence's sweeps into one frame.
    ///
    /// # Errors
    /// As [`Lane::solve`].
    pub async fn densify(&self, work: Densification) -> Result<Densified, EngineError> {
        self.run(move |backend, busy| dense::densify(backend, &work, busy))
            .await
    }

    async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&dyn Backend, &Busy) -> Result<T, EngineError> + Send + 'static,
    ) -> Result<T, EngineError> {
        let gone = || EngineError::Broken("its thread has ended".to_owned());
        let (reply, answer) = oneshot::channel();
        let command = Command::Do(Box::new(Asked { work, reply }));
        let commands = &self.device.lanes[self.place].commands;
        commands.send(command).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }
}

/// Silence in the middle of work after which a device is not taken for ready.
const LONGEST_SILENCE: Duration = Duration::from_secs(30);
