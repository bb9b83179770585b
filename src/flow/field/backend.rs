//! The interface between the fit and a compute device.

use super::network::Network;
use super::snapshot::TrainerState;
use crate::flow::data::{Control, Interrupt, Point};
use crate::flow::distance::{DistanceError, DistanceOptions};
use crate::flow::host::{Host, HostError};
use crate::flow::options::FieldOptions;

/// A device that can fit a field to a pair.
pub trait Backend: Send + Sync {
    /// The device's name, as reports show it.
    fn name(&self) -> String;

    /// The host's thread pool. Registration and the object search run there on every device.
    fn host(&self) -> &Host;

    /// Builds the distance transform of `target` over a grid that covers both clouds, metres.
    /// Checks `control` between parts of the work.
    ///
    /// # Errors
    /// [`BackendError`] if the clouds are refused, the control interrupts or the device fails.
    fn transform(
        &self,
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn Transform>, BackendError>;

    /// The flow of `network` at N `points`: N x 3 displacements, metres.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails.
    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError>;
}

/// The distance transform of a target cloud in a device's memory (FNSF Section 3.2): the distance to
/// the target, metres, sampled on a grid and interpolated trilinearly. A point outside the grid gets
/// the value at the grid's border. All points are in the frame of the two clouds that it was built
/// for. Dropping it frees the memory.
pub trait Transform: Send {
    /// Bytes that it occupies.
    fn bytes(&self) -> usize;

    /// The distance to the target at each of `points`, metres.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails.
    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError>;

    /// Starts a fit of a field to `source`, before its first iteration. `source` has at most as
    /// many points as the transform was built for.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails, or does not support the options.
    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError>;
}

/// A fit in progress.
pub trait Trainer: Send {
    /// Does up to `steps` iterations. Checks `control` before each, or before each group of
    /// iterations that a GPU does at once. Returns early if a snapshot is due, but only after at
    /// least one iteration.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails.
    fn advance(&mut self, steps: usize, control: &dyn Control) -> Result<Advance, BackendError>;

    /// The flow of the result so far at N `points`: N x 3 displacements, metres. The points need
    /// not be those of the fit.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails.
    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError>;

    /// The iterations, the loss and the time of the distance query so far.
    fn report(&self) -> FitReport;

    /// The state that the following iterations and the result depend on.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails.
    fn state(&mut self) -> Result<TrainerState, BackendError>;

    /// Resumes from `state`, which is that of a trainer with the same points and options.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails.
    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError>;

    /// Limits the fit to `max_iterations`; a cosine schedule then falls to zero at that iteration.
    fn shorten(&mut self, max_iterations: usize);
}

/// How a call of [`Trainer::advance`] ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Advance {
    /// All steps were done, or a snapshot is due; more iterations may follow.
    Continues,
    /// Early stopping fired.
    Converged,
    /// The maximum number of iterations of the options is done.
    Exhausted,
    /// A loss was not finite.
    Diverged,
    /// The control interrupted the fit.
    Interrupted(Interrupt),
}

/// The state of a fit, for reports.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitReport {
    /// Number of iterations done.
    pub iterations: usize,
    /// The iteration, from 1, whose field [`Trainer::evaluate`] uses; the latest one if the result
    /// is a running average.
    pub best_iteration: usize,
    /// Its mean loss, metres; for a running average, the running mean of the batches' losses.
    pub best_loss: f64,
    /// Time of the distance query, seconds: the mean over the threads that ran it.
    pub query_seconds: f64,
}

/// Why a device failed or refused the work.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// The distance transform was refused.
    #[error(transparent)]
    Distance(DistanceError),
    /// The control interrupted the work before the first iteration.
    #[error("interrupted before the first iteration")]
    Interrupted(Interrupt),
    /// The thread pool could not be started.
    #[error(transparent)]
    Threads(#[from] HostError),
    /// No device matches the request.
    #[error("no such device: {0}")]
    NoDevice(String),
    /// The device does not support the options.
    #[error("the device cannot do this: {0}")]
    Unsupported(&'static str),
    /// The pair does not fit in the device's memory.
    #[error("{needed} bytes are needed for the {what}, and the device has {available}")]
    Memory {
        /// The data that does not fit.
        what: &'static str,
        /// Bytes needed.
        needed: u64,
        /// Bytes that the device has for it.
        available: u64,
    },
    /// Other pairs occupy the memory that this pair needs. Retry later.
    #[error("the memory of the device is taken by other pairs")]
    Busy,
    /// The device was lost and must be reopened before further use.
    #[error("the device was lost: {0}")]
    Lost(String),
    /// The device rejected a command: a defect of this program or of the driver.
    #[error("the device failed: {0}")]
    Device(String),
}

impl From<DistanceError> for BackendError {
    fn from(error: DistanceError) -> Self {
        match error {
            DistanceError::Interrupted(interrupt) => Self::Interrupted(interrupt),
            error => Self::Distance(error),
        }
    }
}
