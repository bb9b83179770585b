//! Errors of an estimate.

use super::data::MIN_POINTS;
use super::distance::DistanceError;
use super::field::{BackendError, FitError, LinearError, SnapshotError};
use super::options::LEAST_OVERLAP;

/// The reason why an estimate was rejected or failed.
#[derive(Debug, thiserror::Error)]
pub enum FlowError {
    /// Fewer than [`MIN_POINTS`] points of a cloud are selected: finite, within the crop, not too near
    /// the sensor, and not masked. For a field, [`super::Options::max_points`] below this number causes
    /// it as well.
    #[error("the {cloud} cloud has {points} usable points, at least {MIN_POINTS} are needed")]
    TooFewPoints {
        /// `source` or `target`.
        cloud: &'static str,
        /// Number of selected points.
        points: usize,
    },
    /// [`super::Ground::Mask`] is set, but the problem or one of its used neighbor sweeps has no
    /// ground mask.
    #[error("the ground cannot be masked: the input has no ground masks")]
    NoGroundMask,
    /// A ground mask does not have one flag per point of its cloud.
    #[error("the {cloud} cloud has {points} points but its ground mask has {flags} flags")]
    GroundMaskLength {
        /// `source`, `target` or `neighbor sweep`.
        cloud: &'static str,
        /// Number of flags in the mask.
        flags: usize,
        /// Number of points in the cloud.
        points: usize,
    },
    /// A sweep does not have one time per point.
    #[error("the {cloud} cloud has {points} points but {times} times")]
    TimesLength {
        /// `source`, `target` or `neighbor sweep`.
        cloud: &'static str,
        /// Number of times.
        times: usize,
        /// Number of points in the cloud.
        points: usize,
    },
    /// After the alignment the two sweeps show too little of one scene, see
    /// [`super::LEAST_OVERLAP`].
    #[error(
        "the sweeps do not show one scene: {:.0}% of what one shows is in the other after the best alignment, \
         {:.0}% are needed: are they consecutive sweeps of one sensor, and is a given ego motion \
         target_from_source? The option force (--force) estimates them all the same",
        100.0 * overlap,
        100.0 * LEAST_OVERLAP
    )]
    NoOverlap {
        /// The overlap, 0 to 1.
        overlap: f32,
    },
    /// The points of a sweep lie too far apart for metres, see [`super::MAX_SPREAD_M`].
    #[error(
        "half of the {cloud} cloud's points lie more than {spread_m:.0} m from their middle: coordinates are \
         metres, are these millimetres? The option force (--force) estimates them all the same"
    )]
    NotMetres {
        /// `source` or `target`.
        cloud: &'static str,
        /// Median distance of the points from their middle, metres.
        spread_m: f32,
    },
    /// The control cancelled the estimate.
    #[error("the estimate was cancelled")]
    Cancelled,
    /// The loss of a field was not finite.
    #[error("the optimization diverged at iteration {iteration}")]
    Diverged {
        /// Number of iterations completed before it.
        iteration: usize,
    },
    /// The snapshot was rejected. It belongs to another problem, other options or another method,
    /// or its bytes are not a valid snapshot of this format version.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The distance transform was rejected, or the device failed, is busy, has too little memory or
    /// does not support the options.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

impl From<FitError> for FlowError {
    fn from(error: FitError) -> Self {
        match error {
            FitError::Cancelled => Self::Cancelled,
            FitError::Diverged { iteration } => Self::Diverged { iteration },
            FitError::Backend(error) => Self::Backend(error),
        }
    }
}

impl FlowError {
    /// Whether the input or its options caused the error, rather than the machine.
    ///
    /// True for sweeps of two scenes, coordinates that are not metres, too few points, a missing
    /// ground mask or one of the wrong length, times of the wrong length, an empty target,
    /// clouds that span too much space, a pair that exceeds the allowed memory or the memory of the
    /// device, an option that the device does not support, and a fit that diverges: its seed is fixed,
    /// so that it diverges again. False for all other errors, including an invalid cell or band of the
    /// distance transform.
    pub fn is_input(&self) -> bool {
        match self {
            Self::NoOverlap { .. } | Self::TooFewPoints { .. } => true,
            Self::NotMetres { .. } | Self::Diverged { .. } => true,
            Self::NoGroundMask | Self::GroundMaskLength { .. } | Self::TimesLength { .. } => true,
            Self::Backend(BackendError::Distance(error)) => !matches!(
                error,
                DistanceError::Cell { .. }
                    | DistanceError::Band { .. }
                    | DistanceError::Interrupted(_)
            ),
            Self::Backend(BackendError::Unsupported(_) | BackendError::Memory { .. }) => true,
            Self::Backend(BackendError::Linear(LinearError::Memory { .. })) => true,
            Self::Cancelled | Self::Snapshot(_) | Self::Backend(_) => false,
        }
    }
}
