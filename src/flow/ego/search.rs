//! Where a fit may start: coarse fits from several motions, the best of which is taken.
//!
//! One coarse fit mostly finds turns of 4 degrees and drives of 3 m together; vehicles move forward
//! and turn, so the starts do. The right one scores 0.09 to 0.28. It must not know how exact a
//! motion is in the end.

use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;

use super::fit::{Fit, Schedule};
use super::surfels::{Columns, Surfels};
use super::thin::thinned;
use crate::flow::points::{Point, RigidTransform};
use crate::flow::watch::Watch;

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
/// A start must score this much more than an earlier one to be taken: along a tunnel, all starts
/// are equal, and the prior is the likeliest.
const BETTER: f64 = 0.01;

/// What a thinned cloud's surfels are for this search.
pub(super) fn coarse(points: &[Point]) -> Surfels {
    Surfels::new(Columns::new(&thinned(points, VOXEL_M), CELL_M))
}

/// The motion near `prior` that fits best, to some centimetres; `prior` where none does.
pub(super) fn search(
    source: &Surfels,
    target: &Surfels,
    prior: &RigidTransform,
    watch: &dyn Watch,
) -> RigidTransform {
    let source = source.some(TRIED);
    let fit = Fit::new(&source, target.all());
    let tried: Vec<(RigidTransform, f64)> = starts(prior)
        .into_par_iter()
        .map(|start| {
            let motion = fit.run(&start, &TRIAL, watch);
            (motion, fit.score(&motion, &TRIAL))
        })
        .collect();
    let mut best = (*prior, 0.0);
    for (motion, score) in tried {
        if score > best.1 + BETTER {
            best = (motion, score);
        }
    }
    best.0
}

/// Drives and turns about the prior, itself first.
fn starts(prior: &RigidTransform) -> Vec<RigidTransform> {
    let turned = |degrees: f64| {
        let turn = Vector3::new(0.0, 0.0, degrees.to_radians());
        DRIVES_M.map(|drive| Isometry3::new(Vector3::new(drive, 0.0, 0.0), turn) * prior)
    };
    TURNS_DEG.map(turned).into_iter().flatten().collect()
}
