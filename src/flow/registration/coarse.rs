//! Coarse registration: the best fit from several initial guesses.
//!
//! A single coarse fit mostly recovers a rotation of 4 degrees together with a translation of 3 m.
//! Vehicles drive forward and turn, so the initial guesses are translations along x, or in the end
//! along y, and rotations about z. The correct motion scores 0.06 to 0.28. Rotated guesses are skipped where all guesses
//! without rotation converge to one motion. Guesses far from the prior are tried where no near one
//! aligns the clouds.

use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;

use super::gicp::{Fit, Schedule};
use super::surfels::Surfels;
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::spatial::voxel_mean;

/// Side of the voxels that both clouds are downsampled to, metres.
const VOXEL_M: f32 = 1.0;
/// Radius of the neighborhoods of normals, and range of matches, metres.
const CELL_M: f32 = 3.0;
/// Source points used in the fit from each initial guess.
const TRIED: usize = 512;
/// Schedule of the fit from each initial guess.
const TRIAL: Schedule = Schedule {
    steps: 12,
    within_m: [3.0, 2.0],
    scale_m: [1.0, 0.3],
};
/// Translations of the initial guesses from the prior, along one axis, metres. The first [`NEAR`]
/// suffice for sweeps at 10 Hz, the others for 2 Hz.
const DRIVES_M: [f64; 9] = [0.0, 3.0, -3.0, 6.0, -6.0, 9.0, -9.0, 12.0, -12.0];
/// Rotations of the initial guesses from the prior, about z, degrees.
const TURNS_DEG: [f64; 9] = [0.0, 4.0, -4.0, 8.0, -8.0, 12.0, -12.0, 16.0, -16.0];
/// Number of the translations and rotations of the guesses that are tried first.
const NEAR: usize = 3;
/// Score from which a fit counts as aligned. Fits that were not aligned scored up to 0.03.
const PLAIN: f64 = 0.05;
/// Score of the upright surfels from which a fit is not doubtful. Wrong fits scored up to 0.07, right
/// ones 0.06 to 0.4.
const UPRIGHT_PLAIN: f64 = 0.1;
/// Fits that end closer to each other than this, metres and degrees, have converged to one motion.
const SAME_M: f64 = 0.05;
const SAME_DEG: f64 = 0.1;
/// Margin by which the score of a fit must exceed that of an earlier one. Along a tunnel all
/// initial guesses score alike, and the prior is the most probable.
const BETTER: f64 = 0.01;

/// Coarse surfels of a voxel-downsampled cloud.
pub(super) fn coarse(points: &[Point]) -> Surfels {
    Surfels::new(&voxel_mean(points, VOXEL_M), CELL_M)
}

/// The motion near `prior` with the best score, accurate to some centimetres; `prior` where no fit
/// scores above the margin. Where `control` interrupts, no further guesses are tried.
pub(super) fn search(
    source: &Surfels,
    target: &Surfels,
    prior: &RigidTransform,
    control: &dyn Control,
) -> RigidTransform {
    let source = source.some(TRIED);
    let fit = Fit::new(&source, target);
    let tried = |starts: &[RigidTransform]| -> Vec<(RigidTransform, f64)> {
        let tried = starts.par_iter().map(|start| {
            let motion = fit.run(start, &TRIAL, control);
            (motion, fit.score(&motion, &TRIAL))
        });
        tried.collect()
    };
    let near = 0..NEAR;
    let [x, y] = [Vector3::x(), Vector3::y()];
    let mut ends = tried(&starts(prior, x, |drive, turn| {
        near.contains(&drive) && turn == 0
    }));
    let goes_on = || control.interrupt().is_none();
    if goes_on() && !agree(&ends) {
        let turned = |drive, turn| near.contains(&drive) && near.contains(&turn) && turn > 0;
        ends.extend(tried(&starts(prior, x, turned)));
    }
    let is_doubtful = |(motion, _): &(_, _)| fit.upright_score(motion, &TRIAL) < UPRIGHT_PLAIN;
    if goes_on() && !agree(&ends) && ends.iter().all(is_doubtful) {
        let is_far = |drive, turn| !(near.contains(&drive) && near.contains(&turn));
        ends.extend(tried(&starts(prior, x, is_far)));
        // The y axis of some sensors is forward.
        if goes_on() && ends.iter().all(is_doubtful) {
            ends.extend(tried(&starts(prior, y, |drive, _| drive > 0)));
        }
    }
    let mut best = (*prior, 0.0);
    for (motion, score) in ends {
        if score > best.1 + BETTER {
            best = (motion, score);
        }
    }
    best.0
}

/// Whether fits from initial guesses metres apart have all converged to one motion and count as
/// aligned. Other guesses near them are then taken to converge to the same motion.
fn agree(ends: &[(RigidTransform, f64)]) -> bool {
    let (first, _) = ends[0];
    ends.iter().all(|(motion, score)| {
        let between = first.inv_mul(motion);
        *score >= PLAIN
            && between.translation.vector.norm() < SAME_M
            && between.rotation.angle() < SAME_DEG.to_radians()
    })
}

/// The initial guesses about `prior`, with translations along `axis`, whose indices of translation
/// and rotation `tries` accepts, those with the smallest rotation first.
fn starts(
    prior: &RigidTransform,
    axis: Vector3<f64>,
    tries: impl Fn(usize, usize) -> bool,
) -> Vec<RigidTransform> {
    let mut starts = Vec::new();
    for (turn, degrees) in TURNS_DEG.into_iter().enumerate() {
        for (drive, drive_m) in DRIVES_M.into_iter().enumerate() {
            if tries(drive, turn) {
                let angle = Vector3::new(0.0, 0.0, degrees.to_radians());
                starts.push(Isometry3::new(drive_m * axis, angle) * prior);
            }
        }
    }
    starts
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
        // Clouds that have nothing in common score zero.
        assert!(!agree(&[end(0.0, 5.0, 0.0), end(0.0, 5.0, 0.0)]));
        assert!(!agree(&[end(0.0, 5.0, 0.07), end(0.0, 5.0, f64::NAN)]));
    }
}
