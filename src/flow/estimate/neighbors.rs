//! Registration of the neighbor sweeps of a pair to its target.
//!
//! The prior of each registration is the pair's ego motion, extrapolated at constant velocity.

use super::method::Input;
use crate::flow::data::{AlignedSweep, Control, Point, RigidTransform, transform_points};
use crate::flow::error::FlowError;
use crate::flow::host::Host;
use crate::flow::options::LEAST_OVERLAP;
use crate::flow::registration::overlap;
use crate::flow::select::{cropped, select_neighbor};

/// Remaining time required for a neighbor sweep, seconds per point of it and of the target.
/// Neighbor sweeps are the first work that a deadline drops.
const SECONDS_PER_POINT: f64 = 2e-6;

/// The neighbor sweeps of the problem that the options use and the remaining time allows, in the
/// target's frame, and whether time was left for all of them. `ego` is the ego motion of the pair,
/// target_from_source.
///
/// A neighbor sweep that shows another scene than the target is left out: the sequence has a cut
/// there. Its overlap is measured as that of a pair, see [`overlap()`]. Where the ground is among the
/// points, it is not measured.
///
/// # Errors
/// [`FlowError`] where a ground mask is missing or has another length.
pub(super) fn aligned_neighbors(
    host: &Host,
    input: &Input<'_>,
    ego: &RigidTransform,
) -> Result<(Vec<AlignedSweep>, bool), FlowError> {
    let Input {
        problem,
        selection,
        options,
        control,
        ..
    } = *input;
    let find_ground = |sweeps: &[&[Point]]| host.ground(sweeps);
    let order = problem.nearest_neighbors(options.sweeps());
    if order.is_empty() {
        return Ok((Vec::new(), true));
    }
    let target = cropped(problem.target, options);
    let mut aligned = Vec::with_capacity(order.len());
    for sweep in order {
        let whole = cropped(sweep.points, options);
        if !has_time(whole.len() + target.len(), control) {
            return Ok((aligned, false));
        }
        let points = select_neighbor(sweep, options, &find_ground)?;
        // E^(1 - at): the target itself is at 1.
        let intervals = 1 - i32::from(sweep.at);
        let step = if intervals < 0 { ego.inverse() } else { *ego };
        let repeated = 0..intervals.unsigned_abs();
        let prior = repeated.fold(RigidTransform::identity(), |all, _| step * all);
        let motion = host.align(&whole, &target, &prior, control).motion;
        let points = transform_points(&motion, &points);
        if !selection.has_ground && !options.force {
            let measure = || overlap(&points, &selection.target);
            let shared = host.threads().install(measure);
            if shared.is_some_and(|shared| shared < LEAST_OVERLAP) {
                continue;
            }
        }
        aligned.push(AlignedSweep {
            points,
            at: sweep.at,
        });
    }
    Ok((aligned, true))
}

/// Whether the remaining time allows a neighbor sweep: a registration of `points` points in total,
/// and the search.
fn has_time(points: usize, control: &dyn Control) -> bool {
    let needed = SECONDS_PER_POINT * points as f64;
    control.interrupt().is_none() && control.seconds_left().is_none_or(|left| left > needed)
}
