//! Types of the engine's interface: work, health, errors, and how a device is opened.

use std::sync::Arc;
use std::time::Duration;

use crate::flow::densify::DensifyError;
use crate::flow::field::{Backend, BackendError};
use crate::flow::{Control, FlowError, MotionField, Options, Point, Snapshot, Sweep};
use crate::job::DeviceKind;

/// The input of one estimate on a device: a pair of sweeps, its options and its control.
pub struct Work {
    /// The source sweep: N points (x, y, z), metres.
    pub source: Vec<Point>,
    /// The target sweep: M points (x, y, z), metres.
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
    /// The snapshot of an earlier, interrupted attempt, from which a fit continues. `None`: the
    /// estimate starts afresh.
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
    /// It could not be opened or failed its self-test, with the reason. Both are retried.
    Broken(String),
    /// It has worked, but its last [`ReopenPolicy::tries`] reopenings failed; with the reason.
    /// Opening is still retried, but perhaps only a new process helps.
    Gone(String),
}

/// Why a device returned no result.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The estimate refused its input or failed, the device failed in a densification, or either
    /// work was cancelled.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// A densification has another number of sweeps than its plan, a ground mask of another length
    /// than its sweep, or no field for an edge of the plan.
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

/// An open device, as a [`DeviceFactory`] returns it.
pub trait Opened: Send + Sync {
    /// A backend for one pair. The backends of several lanes work at the same time.
    fn lane(&self) -> Arc<dyn Backend>;

    /// Whether the device is lost. Its results are then discarded.
    fn is_lost(&self) -> bool;

    /// Closes the device and frees its memory. Work that still runs on it fails as lost.
    fn destroy(&self);
}

/// Opens a device. It is called again after a failed try and after a loss.
pub type DeviceFactory = Box<dyn Fn() -> Result<Box<dyn Opened>, BackendError> + Send + Sync>;

/// Pauses between the tries to open a device, and the number of failures after which it counts as
/// given up.
#[derive(Clone, Copy, Debug)]
pub struct ReopenPolicy {
    /// Pause after the first failure. Each later pause is four times as long as the one before. A
    /// success resets the pause.
    pub first_pause: Duration,
    /// Upper limit of the later pauses.
    pub longest_pause: Duration,
    /// Number of consecutive failures at which the health of a device that has worked becomes
    /// [`Health::Gone`].
    pub tries: u32,
}

impl Default for ReopenPolicy {
    /// Six tries with pauses of 0.2, 0.8, 3.2, 12.8 and 30 s between them.
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
    /// Opens the device: at the start, after a failed try and after each loss.
    pub open: DeviceFactory,
    /// Retry policy for opening it.
    pub reopening: ReopenPolicy,
}
