//! The seam to a device: what the solver asks of whatever computes.

use super::network::Network;
use super::snapshot::TrainerState;
use crate::flow::data::{Control, Interrupt, Point};
use crate::flow::distance::{DistanceError, DistanceOptions};
use crate::flow::host::Host;
use crate::flow::options::Options;

/// A device that can fit a field to a pair.
pub trait Backend: Send + Sync {
    /// The device's name, as reports show it.
    fn name(&self) -> String;

    /// The host's threads: they align and find movers whatever the device.
    fn host(&self) -> &Host;

    /// Builds the distance transform of `target` over a grid that covers both clouds; looks at
    /// `control` between its pieces.
    ///
    /// # Errors
    /// [`BackendError`] where the clouds are refused, the watch interrupts or the device fails.
    fn transform(
        &self,
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn Transform>, BackendError>;

    /// What `network` says at `points`: a displacement each, metres.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError>;
}

/// A target's distance transform on a device.
pub trait Transform: Send {
    /// Bytes that it occupies.
    fn bytes(&self) -> usize;

    /// The distance to the target at each of `points`, metres.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError>;

    /// A field at its start, to be fitted to `source`: at most as many points as the transform was
    /// built for.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn start(
        &self,
        source: &[Point],
        options: &Options,
    ) -> Result<Box<dyn Trainer + '_>, BackendError>;
}

/// One optimization in progress.
pub trait Trainer: Send {
    /// Does up to `steps` iterations; looks at `control` before each. Comes back before the steps
    /// are done where a snapshot is due, but never without an iteration.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn advance(&mut self, steps: usize, control: &dyn Control) -> Result<Advance, BackendError>;

    /// The result so far at `points`, which need not be the fitted ones: a displacement each,
    /// metres.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError>;

    /// What has been reached and what it took.
    fn report(&self) -> FitReport;

    /// What the following iterations and the result depend on.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn state(&mut self) -> Result<TrainerState, BackendError>;

    /// Goes on from `state`, which a trainer of the same points and options had.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError>;

    /// Ends after `max_iterations` at the latest, and lets the step size fall accordingly.
    fn shorten(&mut self, max_iterations: usize);
}

/// How a call of [`Trainer::advance`] ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Advance {
    /// All steps were done, or a snapshot is due; more may follow.
    Continues,
    /// The stopping rule fired.
    Converged,
    /// All iterations that the options allow are done.
    Exhausted,
    /// A loss was not a number.
    Diverged,
    /// The watch asked for the end.
    Interrupted(Interrupt),
}

/// What a trainer has reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitReport {
    /// Iterations done.
    pub iterations: usize,
    /// The iteration, from 1, whose field [`Trainer::evaluate`] uses; the latest for an average.
    pub best_iteration: usize,
    /// Its loss, metres; the running mean of the batches' losses for an average.
    pub best_loss: f64,
    /// Seconds in the distance query: the mean over the threads that ran it.
    pub query_seconds: f64,
}

/// Why a device could not go on.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// The distance transform was refused.
    #[error(transparent)]
    Distance(DistanceError),
    /// The watch asked for the end before there was anything to fit to.
    #[error("interrupted before the first iteration")]
    Interrupted(Interrupt),
    /// Threads could not be started.
    #[error("cannot start worker threads: {0}")]
    Threads(String),
    /// No device answers to what was asked for.
    #[error("no such device: {0}")]
    NoDevice(String),
    /// The device cannot do what the options ask for.
    #[error("the device cannot do this: {0}")]
    Unsupported(&'static str),
    /// The pair does not fit on the device.
    #[error("{needed} bytes are needed for the {what}, and the device has {available}")]
    Memory {
        /// What does not fit.
        what: &'static str,
        /// Bytes needed.
        needed: u64,
        /// Bytes that the device has for it.
        available: u64,
    },
    /// Other pairs have the memory that this one needs; later there will be room.
    #[error("the memory of the device is taken by other pairs")]
    Busy,
    /// The device is gone: it must be opened again before it can do anything.
    #[error("the device was lost: {0}")]
    Lost(String),
    /// The device refused a command: a defect of this program or of the driver.
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
