//! Why an estimate was refused or failed.

use super::data::MIN_POINTS;
use super::distance::DistanceError;
use super::field::{BackendError, SnapshotError};

/// Why an estimate was refused or failed.
#[derive(Debug, thiserror::Error)]
pub enum FlowError {
    /// A cloud has too few points, or too few are left of it.
    #[error("the {cloud} cloud has {points} usable points, at least {MIN_POINTS} are needed")]
    TooFewPoints {
        /// `source` or `target`.
        cloud: &'static str,
        /// Points that are finite, in range and not masked.
        points: usize,
    },
    /// Ground points should be masked, but nobody says which they are.
    #[error("the ground cannot be masked: the input has no ground masks")]
    NoGroundMask,
    /// A ground mask belongs to another cloud.
    #[error("the {cloud} cloud has {points} points but its ground mask has {flags} flags")]
    GroundMaskLength {
        /// `source` or `target`.
        cloud: &'static str,
        /// Length of the mask.
        flags: usize,
        /// Points of the cloud.
        points: usize,
    },
    /// Nobody wants the flow any more.
    #[error("the estimate was cancelled")]
    Cancelled,
    /// The loss was not a number.
    #[error("the optimization diverged at iteration {iteration}")]
    Diverged {
        /// Iterations done before.
        iteration: usize,
    },
    /// What should be resumed is something else.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
    /// The device could not go on.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

impl FlowError {
    /// Whether the input is at fault, rather than the machine.
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
