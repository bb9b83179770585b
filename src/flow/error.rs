//! Errors of an estimate.

use super::data::MIN_POINTS;
use super::distance::DistanceError;
use super::field::{BackendError, FitError, SnapshotError};

/// The reason why an estimate was rejected or failed.
#[derive(Debug, thiserror::Error)]
pub enum FlowError {
    /// A cloud has too few points, or too few that are finite, within the crop and not masked.
    #[error("the {cloud} cloud has {points} usable points, at least {MIN_POINTS} are needed")]
    TooFewPoints {
        /// `source` or `target`.
        cloud: &'static str,
        /// Points that are finite, within the crop and not masked.
        points: usize,
    },
    /// [`super::Ground::Mask`] is set, but the problem has no ground masks.
    #[error("the ground cannot be masked: the input has no ground masks")]
    NoGroundMask,
    /// A ground mask does not have one flag per point of its cloud.
    #[error("the {cloud} cloud has {points} points but its ground mask has {flags} flags")]
    GroundMaskLength {
        /// `source`, `target` or `neighbor sweep`.
        cloud: &'static str,
        /// Length of the mask.
        flags: usize,
        /// Points of the cloud.
        points: usize,
    },
    /// The control cancelled the estimate.
    #[error("the estimate was cancelled")]
    Cancelled,
    /// The loss was not a number.
    #[error("the optimization diverged at iteration {iteration}")]
    Diverged {
        /// Completed iterations.
        iteration: usize,
    },
    /// The snapshot was rejected, for example because it belongs to another problem.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The backend failed.
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
    /// Whether the input caused the error, rather than the machine. Includes a pair that exceeds
    /// the device memory and an option that the device does not support. Excludes an invalid cell
    /// or band of the distance transform.
    pub fn is_input(&self) -> bool {
        match self {
            Self::TooFewPoints { .. } | Self::NoGroundMask | Self::GroundMaskLength { .. } => true,
            Self::Backend(BackendError::Distance(error)) => !matches!(
                error,
                DistanceError::Cell { .. }
                    | DistanceError::Band { .. }
                    | DistanceError::Interrupted(_)
            ),
            Self::Backend(BackendError::Unsupported(_) | BackendError::Memory { .. }) => true,
            Self::Cancelled | Self::Diverged { .. } | Self::Snapshot(_) | Self::Backend(_) => false,
        }
    }
}
