//! A sequence's sweeps carried into one frame on a device. It must not know queues or stores.

use std::collections::HashMap;
use std::sync::Arc;

use super::EngineError;
use super::busy::Busy;
use super::lane::Heard;
use crate::flow::densify;
use crate::flow::densify::{DensifyError, FlowEdge, Plan};
use crate::flow::field::{Backend, BackendError};
use crate::flow::{Control, DenseCloud, FlowError, MotionField, Sweep};

/// Sweeps to be carried into one frame.
pub struct Densification {
    /// Which frame, and how.
    pub plan: Plan,
    /// All sweeps, in order.
    pub sweeps: Vec<Sweep>,
    /// A field for each edge of the plan.
    pub fields: HashMap<FlowEdge, MotionField>,
    /// Looks in on it.
    pub control: Arc<dyn Control + Send + Sync>,
}

/// A dense cloud, and what carried its points, as reports show it.
#[derive(Debug)]
pub struct Densified {
    /// The points of all sweeps.
    pub cloud: DenseCloud,
    /// The device, or the host's threads.
    pub device: String,
}

/// Carries the sweeps. Half of a dense cloud is none: an interrupt of any kind ends it without.
pub(super) fn densify(
    backend: &dyn Backend,
    work: &Densification,
    busy: &Busy,
) -> Result<Densified, EngineError> {
    let control = Heard {
        control: work.control.as_ref(),
        busy,
    };
    let field = |edge| work.fields.get(&edge);
    let cloud = densify::densify(backend, &work.plan, &work.sweeps, field, &control);
    let cloud = cloud.map_err(|error| match error {
        DensifyError::Interrupted(_) | DensifyError::Backend(BackendError::Interrupted(_)) => {
            FlowError::Cancelled.into()
        }
        DensifyError::Backend(error) => FlowError::Backend(error).into(),
        error => EngineError::Densify(error),
    })?;
    let device = densify::carrier(backend, work.fields.values());
    Ok(Densified { cloud, device })
}
