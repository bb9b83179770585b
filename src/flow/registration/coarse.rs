//! Where a fit may start: coarse fits from several motions, the best of which is taken.
//!
//! One coarse fit mostly finds turns of 4 degrees and drives of 3 m together; vehicles move forward
//! and turn, so the starts do. The right one scores 0.06 to 0.28. Turned starts are left out where those
//! along the way end together. It must not know how exact a motion is in the end.

use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;

use super::gicp::{Fit, Schedule};
use super::surfels::{Columns, Surfels};
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::spatial::voxel_mean;

/// Side of the voxels that both clouds are thinned to, metres.
const VOXEL_M: f32 = 1.0;
/// Normals are taken, and matches are sought, within this, metres.
const CELL_M: f32 = 3.0;
/// Source points that each start is tried on.
const TRIED: usize = 512;
/// The fit of each start.
const TRIAL: Schedule = Schedule {
    steps: 12,
    within_m: [3.0, 2.0],
    scale_m: [1.0, 0.3],
};
/// Drives from the prior, along x, metres.
const DRIVES_M: [f64; 3] = [0.0, 3.0, -3.0];
/// Turns from the prior, about z, degrees.
const TURNS_DEG: [f64; 3] = [0.0, 4.0, -4.0];
/// A fit that scores this is of clouds that have found each other: others scored up to 0.03.
const PLAIN: f64 = 0.05;
/// Fits that end nearer to each other than this, metres and degrees, end at one motion.
const SAME_M: f64 = 0.05;
const SAME_DEG: f64 = 0.1;
/// A start must score this much more than an earlier one to be taken: along a tunnel, all starts
/// are equal, and the prior is the likeliest.
const BETTER: f64 = 0.01;

/// What a thinned cloud's surfels are for this search.
pub(super) fn coarse(points: &[Point]) -> Surfels {
    Surfels::new(Columns::new(&voxel_mean(points, VOXEL_M), CELL_M))
}

/// The motion near `prior` that fits best, to some centimetres; `prior` where none does.
pub(super) fn search(
    source: &Surfels,
    target: &Surfels,
    prior: &RigidTransform,
    control: &dyn Control,
) -> RigidTransform {
    let source = source.some(TRIED);
    let fit = Fit::new(&source, target.all());
    let tried = |starts: &[RigidTransform]| -> Vec<(RigidTransform, f64)> {
        let tried = starts.par_iter().map(|start| {
            let motion = fit.run(start, &TRIAL, control);
            (motion, fit.score(&motion, &TRIAL))
        });
        tried.collect()
    };
    let starts = starts(prior);
    let (straight, turned) = starts.split_at(DRIVES_M.len());
    let mut ends = tried(straight);
    if !agree(&ends) {
        ends.extend(tried(turned));
    }
    let mut best = (*prior, 0.0);
    for (motion, score) in ends {
        if score > best.1 + BETTER {
            best = (motion, score);
        }
    }
    best.0
}

/// Whether fits that began metres apart ended at one motion, and one that plainly fits: no start about
/// them would end anywhere else.
fn agree(ends: &[(RigidTransform, f64)]) -> bool {
    let (first, _) = ends[0];
    ends.iter().all(|(motion, score)| {
        let between = first.inv_mul(motion);
        *score >= PLAIN
            && between.translation.vector.norm() < SAME_M
            && between.rotation.angle() < SAME_DEG.to_radians()
    })
}

/// Drives and turns about the prior, itself first.
fn starts(prior: &RigidTransform) -> Vec<RigidTransform> {
    let turned = |degrees: f64| {
        let turn = Vector3::new(0.0, 0.0, degrees.to_radians());
        DRIVES_M.map(|drive| Isometry3::new(Vector3::new(drive, 0.0, 0.0), turn) * prior)
    };
    TURNS_DEG.map(turned).into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn starts_agree_where_they_end_at_one_motion_and_that_fits() {
        let end = |x: f64, degrees: f64, score: f64| {
            let turn = Vector3::new(0.0, 0.0, degrees.to_radians());
            let motion = Isometry3::new(Vector3::new(20.0 + x, 0.0, 0.0), turn);
            (motion, score)
        };
        assert!(agree(&[end(0.0, 5.0, 0.07), end(0.01, 5.01, 0.07)]));
        assert!(!agree(&[end(0.0, 5.0, 0.07), end(0.2, 5.0, 0.07)]));
        assert!(!agree(&[end(0.0, 5.0, 0.07), end(0.0, 5.5, 0.07)]));
        // Nothing holds clouds that have nothing in common: all starts stay together.
        assert!(!agree(&[end(0.0, 5.0, 0.0), end(0.0, 5.0, 0.0)]));
        assert!(!agree(&[end(0.0, 5.0, 0.07), end(0.0, 5.0, f64::NAN)]));
    }
}
