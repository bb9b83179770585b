//! The seam to a device: what the solver asks of whatever computes.

use super::distance::DistanceError;
use super::options::Options;
use super::points::Point;
use super::watch::{Interrupt, Watch};

/// A device that can fit a field to a pair.
pub trait Backend: Send + Sync {
    /// The device's name, as reports show it.
    fn name(&self) -> String;

    /// Builds the target's distance transform and a field at its start.
    ///
    /// # Errors
    /// [`BackendError`] where the pair does not fit or the device fails.
    fn start(
        &self,
        source: &[Point],
        target: &[Point],
        options: &Options,
    ) -> Result<Box<dyn Trainer>, BackendError>;
}

/// One optimization in progress.
pub trait Trainer: Send {
    /// Does up to `steps` iterations.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn advance(&mut self, steps: usize, watch: &dyn Watch) -> Result<Advance, BackendError>;

    /// The best field so far at `points`: a displacement each, metres.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError>;

    /// What has been reached and what it took.
    fn report(&self) -> Report;
}

/// How an [`Trainer::advance`] ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Advance {
    /// All steps were done; more may follow.
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
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Report {
    /// Iterations done.
    pub iterations: usize,
    /// The iteration whose field [`Trainer::evaluate`] uses, from 1.
    pub best_iteration: usize,
    /// Its loss: mean distance to the target, metres.
    pub best_loss: f64,
    /// Seconds in the distance query, summed over threads and divided by them.
    pub query_seconds: f64,
    /// Seconds in the network and its optimizer.
    pub network_seconds: f64,
    /// Bytes of the distance transform.
    pub distance_bytes: usize,
}

/// Why a device could not go on.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// The distance transform was refused.
    #[error(transparent)]
    Distance(#[from] DistanceError),
    /// Threads could not be started.
    #[error("cannot start worker threads: {0}")]
    Threads(String),
}
