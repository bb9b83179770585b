//! Other sweeps of a pair's sequence, moved rigidly into the target's frame.
//!
//! Each is aligned with the target, ground and all, near where the pair's ego motion at a constant
//! velocity puts it. It must not know what the sweeps are for.

use crate::flow::data::{Control, Point, RigidTransform, transform_points};
use crate::flow::error::FlowError;
use crate::flow::field::{Backend, budget};
use crate::flow::options::Options;
use crate::flow::select;
use crate::flow::select::Problem;

/// Another sweep of the sequence that a pair is of.
#[derive(Clone, Copy, Debug)]
pub struct NeighborSweep<'a> {
    /// Points, metres, in the sensor's frame of the sweep.
    pub points: &'a [Point],
    /// As many flags: which points are ground; as [`Problem::ground`].
    pub ground: Option<&'a [bool]>,
    /// When it was taken, in gaps of the pair after the source: the target is at 1, the sweep
    /// before the source at -1.
    pub at: i8,
}

/// What takes part of a sweep around, in the target's frame.
#[derive(Clone, Debug)]
pub struct AlignedSweep {
    /// Points off the ground, metres.
    pub points: Vec<Point>,
    /// As [`NeighborSweep::at`].
    pub at: i8,
}

/// The sweeps around the pair of `problem` that `frames` sweeps in all leave room for: the nearest in
/// time first, the earlier of two as near.
pub(crate) fn nearest<'a>(problem: &Problem<'a>, frames: usize) -> Vec<&'a NeighborSweep<'a>> {
    let mut order: Vec<&NeighborSweep> = problem.around.iter().collect();
    order.sort_by_key(|sweep| ((2 * i16::from(sweep.at) - 1).abs(), sweep.at));
    order.truncate(frames.saturating_sub(2));
    order
}

/// The sweeps of `problem` around the pair that `frames` sweeps in all leave room for and that there
/// is time for: the nearest in time first, the earlier of two as near.
pub(crate) fn aligned(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    ego: &RigidTransform,
    frames: usize,
    control: &dyn Control,
) -> Result<Vec<AlignedSweep>, FlowError> {
    let order = nearest(problem, frames);
    if order.is_empty() {
        return Ok(Vec::new());
    }
    let find_ground = |sweeps: &[&[Point]]| backend.host().ground(sweeps);
    let target = select::in_range(problem.target, options);
    let mut found = Vec::with_capacity(order.len());
    for sweep in order {
        let registration_clouds = select::in_range(sweep.points, options);
        if !budget::has_time_around(registration_clouds.len() + target.len(), control) {
            break;
        }
        let points = select::off_ground(sweep, options, &find_ground)?;
        // E^(1 - at): the target's own frame is at 1.
        let gaps = 1 - i32::from(sweep.at);
        let step = if gaps < 0 { ego.inverse() } else { *ego };
        let prior = (0..gaps.unsigned_abs()).fold(RigidTransform::identity(), |all, _| step * all);
        let motion = backend
            .host()
            .align(&registration_clouds, &target, &prior, control);
        found.push(AlignedSweep {
            points: transform_points(&motion, &points),
            at: sweep.at,
        });
    }
    Ok(found)
}
