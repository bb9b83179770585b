//! Registration of the neighbor sweeps of a pair to its target.
//!
//! The prior of each registration is the pair's ego motion, extrapolated at constant velocity.

use crate::flow::data::{AlignedSweep, Control, RigidTransform, transform_points};
use crate::flow::error::FlowError;
use crate::flow::host::Host;
use crate::flow::options::Options;
use crate::flow::problem::Problem;
use crate::flow::select::{FindGround, cropped, select_neighbor};

/// Remaining time required for a neighbor sweep, seconds per point of it and of the target.
/// Neighbor sweeps are the first work that a deadline drops.
const SECONDS_PER_POINT: f64 = 2e-5;

/// The neighbor sweeps of `problem` that the options use and the remaining time allows, in the
/// target's frame. `ego` is the ego motion of the pair, target_from_source.
///
/// # Errors
/// [`FlowError`] where a ground mask is missing or has another length.
pub(super) fn aligned_neighbors(
    host: &Host,
    problem: &Problem,
    options: &Options,
    ego: &RigidTransform,
    find: FindGround<'_>,
    control: &dyn Control,
) -> Result<Vec<AlignedSweep>, FlowError> {
    let order = problem.nearest_neighbors(options.sweeps());
    if order.is_empty() {
        return Ok(Vec::new());
    }
    let target = cropped(problem.target, options);
    let mut aligned = Vec::with_capacity(order.len());
    for sweep in order {
        let whole = cropped(sweep.points, options);
        if !has_time(whole.len() + target.len(), control) {
            break;
        }
        let points = select_neighbor(sweep, options, find)?;
        // E^(1 - at): the target itself is at 1.
        let intervals = 1 - i32::from(sweep.at);
        let step = if intervals < 0 { ego.inverse() } else { *ego };
        let repeated = 0..intervals.unsigned_abs();
        let prior = repeated.fold(RigidTransform::identity(), |all, _| step * all);
        let motion = host.align(&whole, &target, &prior, control).motion;
        aligned.push(AlignedSweep {
            points: transform_points(&motion, &points),
            at: sweep.at,
        });
    }
    Ok(aligned)
}

/// Whether the remaining time allows a neighbor sweep: a registration of `points` points in total,
/// and the search.
fn has_time(points: usize, control: &dyn Control) -> bool {
    let needed = SECONDS_PER_POINT * points as f64;
    control.interrupt().is_none() && control.seconds_left().is_none_or(|left| left > needed)
}
