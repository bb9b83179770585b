//! The interface between the fit and a compute device.

use super::fitted::FittedField;
use super::linear::LinearError;
use super::network::Network;
use super::snapshot::TrainerState;
use crate::flow::data::{Control, Interrupt, Point};
use crate::flow::distance::DistanceError;
use crate::flow::host::{Host, HostError};
use crate::flow::objects::{FoundInScene, PackedScene};
use crate::flow::options::{FieldOptions, LossOptions};

/// A device that prepares targets, fits fields to them and evaluates fitted networks.
pub trait Backend: Send + Sync {
    /// The device's name, as reports show it.
    fn name(&self) -> String;

    /// The host's thread pool. Registration and the object search run there on every device, but for
    /// the normals and the clusters of [`Self::searches_clusters`].
    fn host(&self) -> &Host;

    /// Whether the host's threads compute the fits. They are the reference that the self-test of
    /// any other device is compared with.
    fn is_cpu(&self) -> bool {
        false
    }

    /// Whether the device finds the normals and searches the clusters of an object search, instead of
    /// the host's threads.
    fn searches_clusters(&self) -> bool {
        false
    }

    /// Finds the normals of a scene, and searches its clusters in their order until `is_over` is true.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] on a device that searches none. [`BackendError::Memory`],
    /// [`BackendError::Busy`], [`BackendError::Lost`] or [`BackendError::Device`] if a GPU has no
    /// memory for the scene or fails.
    fn search_clusters(
        &self,
        scene: &PackedScene,
        is_over: &dyn Fn() -> bool,
    ) -> Result<FoundInScene, BackendError> {
        let _nothing_is_searched = (scene, is_over);
        Err(BackendError::Unsupported("it searches no clusters"))
    }

    /// Prepares `target` (M x 3, metres) for fits to the loss `options`: builds its distance
    /// transform on a grid that covers `target` and `source` (N x 3, metres), or its k-d tree. Both
    /// clouds are in the same frame. Coordinates must not be NaN. Checks `control` before each part
    /// of a distance transform.
    ///
    /// # Errors
    /// - [`BackendError::Distance`] if the clouds or the options are refused, see
    ///   [`crate::flow::distance::DistanceTransform::build`]. For a Chamfer distance only an empty
    ///   target is refused.
    /// - [`BackendError::Truncation`] if the truncation of a Chamfer distance is out of range.
    /// - [`BackendError::Interrupted`] if `control` interrupts.
    /// - [`BackendError::Unsupported`] if the device lacks the search of a Chamfer distance, or the
    ///   metric or the sites of a distance transform. A GPU has only
    ///   [`crate::flow::options::NearestSearch::BruteForce`],
    ///   [`crate::flow::distance::Metric::Euclidean`] and
    ///   [`crate::flow::distance::Sites::Cells`].
    /// - [`BackendError::Memory`] if the target and N points do not fit in the memory that the GPU
    ///   allocated when it was opened, or a temporary buffer exceeds the GPU's largest buffer.
    /// - [`BackendError::Busy`] if other pairs occupy that memory and release too little of it, or
    ///   the GPU has no free memory for a temporary buffer.
    /// - [`BackendError::Lost`] or [`BackendError::Device`] if the GPU fails.
    fn prepare_target(
        &self,
        source: &[Point],
        target: &[Point],
        options: &LossOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn PreparedTarget>, BackendError>;

    /// The flow of `network` at `points` (N x 3, metres): N x 3 displacements, metres.
    ///
    /// # Errors
    /// [`BackendError::Memory`], [`BackendError::Busy`], [`BackendError::Lost`] or
    /// [`BackendError::Device`] if a GPU has no memory for the points or fails. A CPU never fails.
    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError>;
}

/// A target cloud that is prepared for a loss, in a device's memory: its distance transform (FNSF
/// Section 3.2), or the cloud with what the search of nearest neighbors needs.
///
/// All points are in the frame of the two clouds that it was prepared with. Dropping it frees the
/// memory.
pub trait PreparedTarget: Send {
    /// Bytes of the device's memory that it occupies, without the source points.
    fn bytes(&self) -> usize;

    /// N distances to the target, metres, one for each of `points` (N x 3, metres).
    ///
    /// Those of a distance transform are sampled on its grid and interpolated trilinearly. A point
    /// outside the grid gets the distance at the nearest position on the grid's border. Without a
    /// transform the distances are those to the nearest target points.
    ///
    /// # Errors
    /// [`BackendError::Memory`], [`BackendError::Busy`], [`BackendError::Lost`] or
    /// [`BackendError::Device`] if a GPU has no memory for the points or fails. A CPU never fails.
    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError>;

    /// Prepares the way back of a cycle, from the target to `source` (N x 3, metres), which is the
    /// source of [`Self::start`]: builds the distance transform of the source, with the cells of the
    /// target's. A fit with the cycle of NSFP to a distance transform needs it. Checks `control` before
    /// each part.
    ///
    /// # Errors
    /// As [`Backend::prepare_target`].
    fn prepare_cycle(
        &mut self,
        source: &[Point],
        control: &dyn Control,
    ) -> Result<(), BackendError> {
        let _nothing_is_needed = (source, control);
        Ok(())
    }

    /// Starts a fit of a field to `source` (N x 3, metres) and returns it before its first
    /// iteration. `source` must have at least one point, which is not checked. It must have at most
    /// as many points as the source that the target was prepared with; only a GPU refuses more. The
    /// loss of `options` must be the one that the target was prepared for, except for the margin,
    /// the truncation and the penalty. `seed` determines the initial parameters and the batches.
    ///
    /// # Errors
    /// - [`BackendError::Unsupported`] if the target was prepared for another kind of loss or for no
    ///   cycle, or the device lacks the precision of `options`. A CPU has only single precision. Half
    ///   precision needs a GPU whose matrix units pass their self-test. A GPU also lacks what
    ///   [`FieldOptions::runs_on_gpu`] excludes.
    /// - [`BackendError::Linear`] if an option of the linear model is out of range, or its grid needs
    ///   too much memory.
    /// - [`BackendError::Memory`] if a GPU has too little memory for the points, for the gradients of
    ///   a batch, or for a linear model.
    /// - [`BackendError::Busy`] if all lanes of a GPU are in use, or other linear models take its
    ///   memory.
    /// - [`BackendError::Lost`] if the GPU is lost.
    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError>;
}

/// A fit of a field in progress: it iterates, evaluates its result, and saves and restores its
/// state. [`PreparedTarget::start`] makes it.
pub trait Trainer: Send {
    /// Does up to `steps` iterations and reports the progress of each to `control`. Checks
    /// `control` before each iteration, or before each group of iterations that a GPU does at once.
    /// Returns early if the fit ends or `control` interrupts, see [`Advance`]. After at least one
    /// iteration it also returns early if a snapshot is due.
    ///
    /// # Errors
    /// [`BackendError::Busy`], [`BackendError::Lost`] or [`BackendError::Device`] if a GPU has no
    /// free memory or fails. A CPU never fails.
    fn advance(&mut self, steps: usize, control: &dyn Control) -> Result<Advance, BackendError>;

    /// The flow of the result so far at `points` (N x 3, metres): N x 3 displacements, metres. The
    /// points need not be those of the fit. Before the first iteration the result is the network
    /// with its initial parameters.
    ///
    /// # Errors
    /// [`BackendError::Memory`], [`BackendError::Busy`], [`BackendError::Lost`] or
    /// [`BackendError::Device`] if a GPU has no memory for the points or fails. A CPU never fails.
    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError>;

    /// The result so far. Before the first iteration it is the model with its initial parameters.
    ///
    /// # Errors
    /// As [`Self::state`].
    fn fitted(&mut self) -> Result<FittedField, BackendError>;

    /// The number of iterations, the loss and the time of the distance query so far.
    fn report(&self) -> FitReport;

    /// A copy of the state that the following iterations and the result depend on. None while they
    /// also depend on nearest neighbors of an earlier iteration, which are not part of it.
    ///
    /// # Errors
    /// [`BackendError::Busy`], [`BackendError::Lost`] or [`BackendError::Device`] if a GPU has no
    /// free memory or fails. A CPU never fails.
    fn state(&mut self) -> Result<Option<TrainerState>, BackendError>;

    /// Replaces the state of this fit by `state`. To continue the fit that `state` is from with the
    /// same bits, this fit must have the same points, options and seed.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] if `state` has another number of parameters,
    /// [`BackendError::Busy`] if a GPU has no free memory, and [`BackendError::Lost`] if it is lost.
    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError>;

    /// Lowers the maximum number of iterations to `max_iterations`; a larger value has no effect. A
    /// cosine schedule then falls to zero at the new maximum. If that many iterations are already
    /// done, the next [`Self::advance`] does none.
    fn shorten(&mut self, max_iterations: usize);
}

/// How a call of [`Trainer::advance`] ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Advance {
    /// All steps were done, or a snapshot is due; more iterations may follow.
    Continues,
    /// Early stopping ended the fit.
    Converged,
    /// The maximum number of iterations of the options, or of [`Trainer::shorten`], is done.
    Exhausted,
    /// The loss of an iteration was not finite. That iteration does not count as done.
    Diverged,
    /// The control interrupted the fit, for the reason given.
    Interrupted(Interrupt),
}

/// How far a fit has come: its iterations, its loss, and the time of its distance queries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitReport {
    /// Number of iterations done.
    pub iterations: usize,
    /// The iteration, counted from 1, whose field [`Trainer::evaluate`] uses; the latest one if the
    /// result is a running average. Zero before the first iteration.
    pub best_iteration: usize,
    /// Mean loss of that iteration, in the unit of the loss; for a running average, the running mean
    /// of the batches' losses. Infinite before the first iteration.
    pub best_loss: f64,
    /// Time of the distance queries or of the correspondences so far, seconds. On a CPU it is the mean over the threads that
    /// ran them, by the control's clock. On a GPU it is estimated from timestamps. Zero without a
    /// clock or timestamps.
    pub query_seconds: f64,
}

/// Why a device failed or refused the work.
#[derive(Debug, thiserror::Error)]
pub enum BackendError {
    /// The distance transform was refused: its options are out of range, the target is empty, the
    /// clouds span too much space, or `max_bytes` is too small.
    #[error(transparent)]
    Distance(DistanceError),
    /// The truncation of a Chamfer distance is not a positive, finite number of metres.
    #[error("a truncation of {truncation_m} m is not possible: choose more than 0 m")]
    Truncation {
        /// The requested truncation, metres.
        truncation_m: f32,
    },
    /// The linear model was refused: an option is out of range, or its grid needs too much memory.
    #[error(transparent)]
    Linear(#[from] LinearError),
    /// The control interrupted the work on a target, or the wait for a device.
    #[error("interrupted")]
    Interrupted(Interrupt),
    /// The thread pool could not be started.
    #[error(transparent)]
    Threads(#[from] HostError),
    /// No device matches the request, or the driver refused to open it.
    #[error("no such device: {0}")]
    NoDevice(String),
    /// The device does not support the metric, the sites or the precision asked for, or a
    /// measurement is not possible on it. The text says which.
    #[error("the device cannot do this: {0}")]
    Unsupported(&'static str),
    /// The GPU has too little memory, for its kernels when it is opened or for this pair.
    #[error("{needed} bytes are needed for the {what}, and the device has {available}")]
    Memory {
        /// The data that does not fit.
        what: &'static str,
        /// Bytes needed.
        needed: u64,
        /// Bytes that the device has for it.
        available: u64,
    },
    /// The GPU has too little free memory now, or all its lanes are in use by other pairs. Retry
    /// later.
    #[error("the memory of the device is taken by other pairs")]
    Busy,
    /// The GPU was lost and must be opened again before further use: the driver reported an error,
    /// it did not answer in time, or it was destroyed. The text is the reason.
    #[error("the device was lost: {0}")]
    Lost(String),
    /// The GPU rejected a command: a defect of this program or of the driver.
    #[error("the device failed: {0}")]
    Device(String),
}

impl BackendError {
    /// Whether the device only lacked memory, now or for this pair. This is no evidence against it.
    pub(crate) fn is_out_of_memory(&self) -> bool {
        matches!(self, Self::Busy | Self::Memory { .. })
    }
}

impl From<DistanceError> for BackendError {
    fn from(error: DistanceError) -> Self {
        match error {
            DistanceError::Interrupted(interrupt) => Self::Interrupted(interrupt),
            error => Self::Distance(error),
        }
    }
}

/// The error of a fit to another kind of loss than the one that the target was prepared for.
pub(crate) const OTHER_LOSS: BackendError =
    BackendError::Unsupported("the target was prepared for another kind of loss");

/// Checks that `state` is that of a model with so many parameters.
///
/// # Errors
/// [`BackendError::Unsupported`] if it is not.
pub(crate) fn check_state(state: &TrainerState, parameters: usize) -> Result<(), BackendError> {
    if state.parameters.as_slice().len() == parameters {
        Ok(())
    } else {
        let text = "the state belongs to a model with another number of parameters";
        Err(BackendError::Unsupported(text))
    }
}
