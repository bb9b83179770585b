//! Errors of densification.

use super::plan::FlowEdge;
use crate::flow::data::Interrupt;
use crate::flow::field::BackendError;

/// Why a sequence could not be densified.
#[derive(Debug, thiserror::Error)]
pub enum DensifyError {
    /// The plan was made for another number of sweeps.
    #[error("{sweeps} sweeps, and a plan for {planned}")]
    Sweeps {
        /// Number of sweeps given.
        sweeps: usize,
        /// Number of sweeps in the plan.
        planned: usize,
    },
    /// The motion field of this edge of the plan is missing.
    #[error("no field from sweep {} to sweep {}", .0.source, .0.target)]
    NoField(FlowEdge),
    /// The ground mask of the sweep with this index has another length than the sweep.
    #[error("sweep {0}: the ground mask has another number of rows than the sweep")]
    Mask(usize),
    /// The control interrupted; no partial result is returned.
    #[error("interrupted")]
    Interrupted(Interrupt),
    /// The device failed to evaluate a motion field.
    #[error(transparent)]
    Backend(#[from] BackendError),
}
