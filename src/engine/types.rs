//! Types of the engine's interface: work, health, errors, and how a device is opened.

use std::sync::Arc;
use std::time::Duration;

use crate::flow::densify::DensifyError;
use crate::flow::field::{Backend, BackendError};
use crate::flow::{Control, FlowError, MotionField, Options, Point, Snapshot, Sweep};
use crate::job::DeviceKind;

/// One pair for a device.
pub struct Work {
    /// The source sweep: N points, metres.
    pub source: Vec<Point>,
    /// The target sweep: M points, metres.
    pub target: Vec<Point>,
    /// Ground flags of the source (N) and the target (M), if they are known.
    pub ground: Option<[Vec<bool>; 2]>,
    /// The motion field of the preceding pair of a chain, for a warm start.
    pub before: Option<MotionField>,
    /// Neighbor sweeps of the sequence. The number is the sweep's time after the source, in units
    /// of the interval from source to target.
    pub neighbors: Vec<(Sweep, i8)>,
    /// Options of the estimate.
    pub options: Options,
    /// The snapshot of an earlier, interrupted attempt.
    pub snapshot: Option<Snapshot>,
    /// Time, deadline, interruption and progress.
    pub control: Arc<dyn Control + Send + Sync>,
}

/// Health of a device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Health {
    /// It is being opened or self-tested.
    Starting,
    /// It has passed its self-test.
    Ready,
    /// It cannot be used, with the reason. Opening it is retried.
    Broken(String),
    /// It has worked and does not recover after repeated openings, with the reason. Opening is
    /// still retried, but only a new process may help.
    Gone(String),
}

/// Why a device returned no result.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The estimate refused its input, failed or was cancelled, or the device failed in a
    /// densification.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// The sweeps, their ground masks or the fields do not fit the plan of a densification.
    #[error(transparent)]
    Densify(DensifyError),
    /// The work panicked, with this message. The device must pass its self-test again.
    #[error("the solver panicked: {0}")]
    Panicked(String),
    /// The device was lost during the work, with the reason. It is reopened.
    #[error("the device was lost: {0}")]
    Lost(String),
    /// The device could not start the work: it cannot be opened, is being opened again, or the
    /// lane's thread has ended.
    #[error("the device cannot be used: {0}")]
    Broken(String),
}

/// An open device.
pub trait Opened: Send + Sync {
    /// A backend for one pair. The backends of several lanes work at the same time.
    fn lane(&self) -> Arc<dyn Backend>;

    /// Whether the device is lost. Its results are then discarded.
    fn is_lost(&self) -> bool;

    /// Closes the device and frees its memory. Work that still runs on it fails as lost.
    fn destroy(&self);
}

/// Opens a device; called again after a loss.
pub type DeviceFactory = Box<dyn Fn() -> Result<Box<dyn Opened>, BackendError> + Send + Sync>;

/// Retry policy for opening a device.
#[derive(Clone, Copy, Debug)]
pub struct ReopenPolicy {
    /// Pause after the first failure. Each later pause is four times as long. A success resets it.
    pub first_pause: Duration,
    /// Upper limit of the pause.
    pub longest_pause: Duration,
    /// Consecutive failures after which a device that has worked is given up.
    pub tries: u32,
}

impl Default for ReopenPolicy {
    /// Six tries in about three quarters of a minute, longer than a driver takes to reset a GPU.
    fn default() -> Self {
        Self {
            first_pause: Duration::from_millis(200),
            longest_pause: Duration::from_secs(30),
            tries: 6,
        }
    }
}

/// Description of a device before it is opened.
pub struct DeviceOptions {
    /// Its name in metrics and logs.
    pub name: String,
    /// Its kind.
    pub kind: DeviceKind,
    /// Number of pairs that run on it at the same time; 0 counts as 1.
    pub lanes: usize,
    /// Opens the device, at the start and after each loss.
    pub open: DeviceFactory,
    /// Retry policy for opening it.
    pub reopening: ReopenPolicy,
}
