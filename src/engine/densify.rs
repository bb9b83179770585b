//! Densification on a device: transforms the sweeps of a sequence into one reference frame.

use std::collections::HashMap;
use std::sync::Arc;

use super::liveness::{Liveness, MonitoredControl};
use super::types::EngineError;
use crate::flow::densify;
use crate::flow::densify::{DensifyError, FlowEdge, Plan};
use crate::flow::field::{Backend, BackendError};
use crate::flow::{Control, DenseCloud, FlowError, MotionField, Sweep};

/// The input of one densification.
pub struct Densification {
    /// The reference time, the edges and the integration parameters.
    pub plan: Plan,
    /// All sweeps of the plan, in order of time.
    pub sweeps: Vec<Sweep>,
    /// A motion field for each edge of the plan.
    pub fields: HashMap<FlowEdge, MotionField>,
    /// Interruption and heartbeat. Any interrupt, a deadline included, cancels the work without a
    /// result.
    pub control: Arc<dyn Control + Send + Sync>,
}

/// A dense cloud, and the name of the device that computed it.
#[derive(Debug)]
pub struct Densified {
    /// The points of all sweeps in the frame of the reference time.
    pub cloud: DenseCloud,
    /// The name of the device, or of the host's threads if no field is a network.
    pub device: String,
}

/// Runs the densification. A partial cloud is of no use, so any interrupt cancels it without a
/// result.
pub(super) fn densify(
    backend: &dyn Backend,
    work: &Densification,
    liveness: &Liveness,
) -> Result<Densified, EngineError> {
    let control = MonitoredControl {
        control: work.control.as_ref(),
        liveness,
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
