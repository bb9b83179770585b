//! TODO doc

use super::advect::{Context, PropagatedCloud};
use super::plan::{FlowEdge, LaterSweeps, Plan};
use crate::flow::data::{Control, DenseCloud, Interrupt, RigidTransform, control};
use crate::flow::field::{Backend, BackendError};
use crate::flow::motion::{MotionField, Residual};
use crate::flow::sequence::Sweep;

/// Why there is no dense cloud.
#[derive(Debug, thiserror::Error)]
pub enum DensifyError {
    /// The plan is for another number of sweeps.
    #[error("{sweeps} sweeps, and a plan for {planned}")]
    Sweeps {
        /// Sweeps there.
        sweeps: usize,
        /// Sweeps planned for.
        planned: usize,
    },
    /// A field of the plan is missing.
    #[error("no field from sweep {} to sweep {}", .0.source, .0.target)]
    NoField(FlowEdge),
    /// A sweep's mask has another length than the sweep.
    #[error("sweep {0}: the ground mask has another number of rows than the sweep")]
    Mask(usize),
    /// The watch asked for the end; half of a dense cloud is none.
    #[error("interrupted")]
    Interrupted(Interrupt),
    /// The device failed.
    #[error(transparent)]
    Backend(#[from] BackendError),
}

/// Carries the points of all `sweeps` as `plan` says, through the fields that `field` gives for each of
/// [`Plan::edges`]. Points that are not finite, or 1,000 km away, are left out. A sweep's ground mask, where it has one,
/// names points that never move of themselves.
///
/// # Errors
/// [`DensifyError`] where sweeps or fields are missing, the watch interrupts or the device fails.
pub fn densify<'a>(
    backend: &dyn Backend,
    plan: &Plan,
    sweeps: &[Sweep],
    field: impl Fn(FlowEdge) -> Option<&'a MotionField>,
    control: &dyn Control,
) -> Result<DenseCloud, DensifyError> {
    if sweeps.len() != plan.sweeps {
        return Err(DensifyError::Sweeps {
            sweeps: sweeps.len(),
            planned: plan.sweeps,
        });
    }
    let masked = |sweep: &Sweep| sweep.ground.as_ref().map_or(sweep.points.len(), Vec::len);
    if let Some(place) = sweeps.iter().position(|s| masked(s) != s.points.len()) {
        return Err(DensifyError::Mask(place));
    }
    let field = |source: usize, target: usize| {
        let edge = FlowEdge { source, target };
        field(edge).ok_or(DensifyError::NoField(edge))
    };
    let by = Context { backend, control };
    let checked = || control::check(control).map_err(DensifyError::Interrupted);

    // Sweeps up to the anchor, forward.
    let (anchor, substeps) = (plan.anchor, plan.substeps);
    let mut earlier = PropagatedCloud::default();
    for (place, sweep) in sweeps[..=anchor].iter().enumerate() {
        checked()?;
        if place > 0 {
            earlier.step(by, field(place - 1, place)?, substeps)?;
        }
        earlier.take(place, sweep);
    }
    // Sweeps behind it, back to the one before which the instant lies.
    let first = if plan.fraction > 0.0 {
        anchor + 1
    } else {
        anchor
    };
    let mut later = PropagatedCloud::default();
    for place in (first..plan.sweeps).rev() {
        checked()?;
        if place + 1 < plan.sweeps {
            match plan.later {
                LaterSweeps::Reverse => later.step(by, field(place + 1, place)?, substeps)?,
                LaterSweeps::Inverse => later.invert(by, field(place, place + 1)?)?,
            }
        }
        if place > anchor {
            later.take(place, &sweeps[place]);
        }
    }
    checked()?;
    if plan.fraction > 0.0 {
        let ahead = field(anchor, anchor + 1)?;
        let step = ahead.ego.unwrap_or_default();
        // The frame of the instant lies a share of the way, and of the turn, between the two sweeps'.
        let instant = part_of(&step, plan.fraction);
        earlier.part_step(by, ahead, plan.fraction)?;
        earlier.transform(&(instant * step.inverse()));
        match plan.later {
            LaterSweeps::Reverse => {
                let back = field(anchor + 1, anchor)?;
                later.part_step(by, back, 1.0 - plan.fraction)?;
            }
            LaterSweeps::Inverse => {
                later.invert(by, ahead)?;
                later.part_step(by, ahead, plan.fraction)?;
                later.transform(&step.inverse());
            }
        }
        later.transform(&instant);
    }
    Ok(earlier.joined(later, plan.into()))
}

/// What carries points through `fields`, as reports show it: the device where one of them is a network,
/// else the host's threads.
pub fn carrier<'a>(
    backend: &dyn Backend,
    fields: impl IntoIterator<Item = &'a MotionField>,
) -> String {
    let is_network = |field: &MotionField| matches!(field.residual, Residual::Network(_));
    if fields.into_iter().any(is_network) {
        backend.name()
    } else {
        backend.host().name().to_owned()
    }
}

/// The part of a rigid motion that is done after `share` of its time.
pub(super) fn part_of(motion: &RigidTransform, share: f64) -> RigidTransform {
    RigidTransform::identity().lerp_slerp(motion, share)
}
