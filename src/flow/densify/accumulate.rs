//! Densification: the sweeps of a sequence, transformed into the frame of one reference time.
//!
//! Earlier sweeps are advected forward and later sweeps backward, sweep by sweep, to the two sweeps
//! around the reference time. A last partial step ends at the reference time itself.

use super::advect::{Context, PropagatedCloud};
use super::error::DensifyError;
use super::plan::{FlowEdge, LaterSweeps, Plan};
use crate::flow::data::{Control, DenseCloud, RigidTransform, control};
use crate::flow::field::Backend;
use crate::flow::motion::{MotionField, Residual};
use crate::flow::sequence::Sweep;

/// Transforms the points of all `sweeps`, in order of time, into the frame of the plan's reference
/// time.
///
/// `field` returns the motion field of each of [`Plan::edges`]. Points with a coordinate that is
/// not finite, or of 1,000 km or more in magnitude, are left out. The points that a sweep's ground
/// mask marks get no residual motion where there is an ego motion. A sweep without a mask has no
/// ground points. In the result the sweeps up to the reference time come first, earliest first, and
/// then the later sweeps, latest first.
///
/// `control` is checked before each sweep, and before each 131,072 points for which a motion field
/// is evaluated.
///
/// # Errors
/// - [`DensifyError::Sweeps`] if the number of sweeps is not the plan's.
/// - [`DensifyError::Mask`] if a ground mask has another length than its sweep.
/// - [`DensifyError::NoField`] if `field` returns none for an edge of the plan.
/// - [`DensifyError::Interrupted`] if `control` interrupts.
/// - [`DensifyError::Backend`] if the device fails.
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
    if let Some(index) = sweeps.iter().position(|s| masked(s) != s.points.len()) {
        return Err(DensifyError::Mask(index));
    }
    let field = |source: usize, target: usize| {
        let edge = FlowEdge { source, target };
        field(edge).ok_or(DensifyError::NoField(edge))
    };
    let by = Context { backend, control };
    let checked = || control::check(control).map_err(DensifyError::Interrupted);

    // Sweeps up to the anchor, forward in time.
    let (anchor, substeps) = (plan.anchor, plan.substeps);
    let mut earlier = PropagatedCloud::default();
    for (index, sweep) in sweeps[..=anchor].iter().enumerate() {
        checked()?;
        if index > 0 {
            earlier.step(by, field(index - 1, index)?, substeps)?;
        }
        earlier.take(index, sweep);
    }
    // Sweeps after the anchor, backward in time. If the reference time lies between two sweeps,
    // they end in the frame of sweep `anchor + 1`.
    let first = if plan.fraction > 0.0 {
        anchor + 1
    } else {
        anchor
    };
    let mut later = PropagatedCloud::default();
    for index in (first..plan.sweeps).rev() {
        checked()?;
        if index + 1 < plan.sweeps {
            match plan.later {
                LaterSweeps::Reverse => later.step(by, field(index + 1, index)?, substeps)?,
                LaterSweeps::Inverse => later.invert(by, field(index, index + 1)?)?,
            }
        }
        if index > anchor {
            later.take(index, &sweeps[index]);
        }
    }
    checked()?;
    if plan.fraction > 0.0 {
        let ahead = field(anchor, anchor + 1)?;
        let step = ahead.ego.unwrap_or_default();
        // The frame of the reference time: translation and rotation are interpolated between the
        // two sweeps' frames.
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
    Ok(earlier.joined(later, plan.reference_time()))
}

/// The name, for reports, of the device that moves points through `fields`: the backend's if any
/// field is a network, else that of the host's threads.
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

/// The part of a rigid motion up to `share` (0 to 1) of its duration: linear in the translation,
/// spherical linear interpolation of the rotation.
pub(super) fn part_of(motion: &RigidTransform, share: f64) -> RigidTransform {
    RigidTransform::identity().lerp_slerp(motion, share)
}
