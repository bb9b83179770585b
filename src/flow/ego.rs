//! Ego motion: the rigid motion that carries most source points onto the target.
//!
//! Gauss-Newton on the distance transform with a redescending weight (Geman and McClure) whose
//! scale shrinks from two metres to a cell, so that movers and occluded points lose their say. Needs
//! no correspondences. Knows only samples of the transform, never the target's points.
//! Whoever owns the transform samples it; the sums are in double precision here.

use nalgebra::{Isometry3, Matrix6, Point3, Translation3, UnitQuaternion, Vector3, Vector6};
use rayon::prelude::*;

use super::backend::BackendError;
use super::distance::Sample;
use super::points::{Point, RigidTransform};
use super::watch::Watch;

/// Points that are looked at: enough for millimetres, few enough for milliseconds.
const SAMPLED: usize = 16_384;
/// Points whose sums one thread takes at a time; sums are added in the points' order.
const POINTS_AT_ONCE: usize = 1024;
/// Steps at most.
const STEPS: usize = 30;
/// Steps over which the weight's scale shrinks.
const SHRINKING_STEPS: usize = 20;
/// Scale of the weight at the first step, metres: the default band. With half of it, motions of
/// more than a metre are not reached.
const FIRST_SCALE_M: f64 = 2.0;
/// Scale of the weight at the end, metres: one cell of the published grid.
const LAST_SCALE_M: f64 = 0.1;
/// A step shorter than this, in metres and radians, is the last.
const STEP_TOLERANCE: f64 = 1e-5;
/// Keeps the normal equations solvable where the scene leaves a direction free.
const DAMPING: f64 = 1e-6;

/// The distance transform at each of the points.
pub(crate) type Samples<'a> = dyn Fn(&[Point]) -> Result<Vec<Sample>, BackendError> + 'a;

/// The motion target_from_source that aligns `source` with the target that `samples` measures the
/// distance to; the motion so far where the watch interrupts.
///
/// # Errors
/// Whatever `samples` fails with.
pub(crate) fn align(
    source: &[Point],
    samples: &Samples,
    watch: &dyn Watch,
) -> Result<RigidTransform, BackendError> {
    let stride = source.len().div_ceil(SAMPLED).max(1);
    let points: Vec<Point3<f64>> = source
        .iter()
        .step_by(stride)
        .map(|p| Point3::from(p.map(f64::from)))
        .collect();
    let Some(center) = mean(&points) else {
        return Ok(RigidTransform::identity());
    };
    let mut target_from_source = RigidTransform::identity();
    for step in 0..STEPS {
        if watch.interrupt().is_some() {
            break;
        }
        let shrunk = (step as f64 / SHRINKING_STEPS as f64).min(1.0);
        let scale = FIRST_SCALE_M * (LAST_SCALE_M / FIRST_SCALE_M).powf(shrunk);
        let pivot = target_from_source * center;
        let moved: Vec<_> = points.iter().map(|p| target_from_source * p).collect();
        let single: Vec<Point> = moved.iter().map(|p| p.map(|c| c as f32).into()).collect();
        let samples = samples(&single)?;
        let Some(update) = gauss_newton_step(&moved, &samples, pivot, scale) else {
            break;
        };
        let translation = Vector3::new(update[0], update[1], update[2]);
        let rotation = UnitQuaternion::new(Vector3::new(update[3], update[4], update[5]));
        let turn = Isometry3::rotation_wrt_point(rotation, pivot);
        target_from_source = Translation3::from(translation) * turn * target_from_source;
        if shrunk == 1.0 && update.norm() < STEP_TOLERANCE {
            break;
        }
    }
    Ok(target_from_source)
}

/// The middle of the points; none where there are none.
fn mean(points: &[Point3<f64>]) -> Option<Point3<f64>> {
    let sum: Vector3<f64> = points.iter().map(|p| p.coords).sum();
    (!points.is_empty()).then(|| Point3::from(sum / points.len() as f64))
}

/// The update (translation, then rotation vector about `pivot`) that minimizes the weighted,
/// linearized distances of the points. About their middle, so that clouds far from the origin are
/// as well conditioned as near ones.
fn gauss_newton_step(
    points: &[Point3<f64>],
    samples: &[Sample],
    pivot: Point3<f64>,
    scale: f64,
) -> Option<Vector6<f64>> {
    let sums: Vec<_> = points
        .par_chunks(POINTS_AT_ONCE)
        .zip(samples.par_chunks(POINTS_AT_ONCE))
        .map(|(points, samples)| normal_equations(points, samples, pivot, scale))
        .collect();
    let mut normal = Matrix6::identity() * DAMPING;
    let mut gradient = Vector6::zeros();
    for (own_normal, own_gradient) in sums {
        normal += own_normal;
        gradient += own_gradient;
    }
    normal.cholesky().map(|factors| factors.solve(&-gradient))
}

/// The points' share of the normal equations: matrix and gradient.
fn normal_equations(
    points: &[Point3<f64>],
    samples: &[Sample],
    pivot: Point3<f64>,
    scale: f64,
) -> (Matrix6<f64>, Vector6<f64>) {
    let mut normal = Matrix6::zeros();
    let mut gradient = Vector6::zeros();
    for (moved, sample) in points.iter().zip(samples) {
        let residual = f64::from(sample.distance);
        let slope = Vector3::from(sample.gradient.map(f64::from));
        let turning = (moved - pivot).cross(&slope);
        let jacobian = Vector6::new(slope.x, slope.y, slope.z, turning.x, turning.y, turning.z);
        let weight = (scale * scale / (scale * scale + residual * residual)).powi(2);
        normal += jacobian * jacobian.transpose() * weight;
        gradient += jacobian * (weight * residual);
    }
    (normal, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::distance::{DistanceOptions, DistanceTransform, Sites};
    use crate::flow::random::Random;
    use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};
    use crate::flow::watch::Unwatched;

    /// Seen: 0.02 to 0.08 degrees.
    const ACCURACY_DEG: f64 = 0.15;

    /// Seen: 12 mm to cells, 54 mm to points. Between two vertices around a point the interpolated
    /// distance is nearly flat, so that a surface is found up to half a cell off; to cells, source
    /// and target are off alike.
    fn accuracy_m(sites: Sites) -> f64 {
        match sites {
            Sites::Cells => 0.02,
            Sites::Points => 0.08,
        }
    }

    fn transform(source: &[Point], target: &[Point], sites: Sites) -> DistanceTransform {
        let options = DistanceOptions {
            sites,
            ..DistanceOptions::default()
        };
        DistanceTransform::build(source, target, &options).expect("a street fits")
    }

    fn found(source: &[Point], transform: &DistanceTransform) -> RigidTransform {
        let samples = |points: &[Point]| {
            Ok(points
                .iter()
                .map(|&point| transform.sample(point))
                .collect())
        };
        align(source, &samples, &Unwatched).expect("the samples do not fail")
    }

    fn street(seed: u64) -> SimulatedPair {
        let options = StreetOptions {
            seed,
            azimuth_steps: 1000,
            ..StreetOptions::default()
        };
        Street::new(&options).unwrap().pair(0).unwrap()
    }

    fn moved(points: &[Point], motion: &RigidTransform) -> Vec<Point> {
        let moved = points
            .iter()
            .map(|p| motion * Point3::from(p.map(f64::from)));
        moved.map(|p| p.map(|c| c as f32).into()).collect()
    }

    fn yaw(translation_m: [f64; 3], degrees: f64) -> RigidTransform {
        let rotation = Vector3::new(0.0, 0.0, degrees.to_radians());
        Isometry3::new(Vector3::from(translation_m), rotation)
    }

    /// Distance in metres and angle in degrees between two motions.
    fn gap(a: &RigidTransform, b: &RigidTransform) -> (f64, f64) {
        let gap = a.inv_mul(b);
        (
            gap.translation.vector.norm(),
            gap.rotation.angle().to_degrees(),
        )
    }

    #[test]
    fn the_motion_of_streets_with_movers_is_found_from_rest() {
        for seed in 0..4 {
            let pair = street(seed);
            for truth in [yaw([0.5, 0.0, 0.0], 1.0), yaw([1.5, 0.1, 0.02], -3.0)] {
                let before = truth.inverse() * pair.target_from_source;
                let source = moved(&pair.source, &before);
                for sites in [Sites::Cells, Sites::Points] {
                    let transform = transform(&source, &pair.target, sites);
                    let found = found(&source, &transform);
                    let (meters, degrees) = gap(&found, &truth);
                    assert!(
                        meters < accuracy_m(sites) && degrees < ACCURACY_DEG,
                        "{seed} {sites:?}: {meters} m, {degrees} degrees"
                    );
                }
            }
        }
    }

    #[test]
    fn identical_clouds_do_not_move() {
        let target = street(5).target;
        for sites in [Sites::Cells, Sites::Points] {
            let transform = transform(&target, &target, sites);
            let found = found(&target, &transform);
            let (meters, degrees) = gap(&found, &RigidTransform::identity());
            assert!(
                meters < accuracy_m(sites) && degrees < ACCURACY_DEG,
                "{meters} m, {degrees} degrees"
            );
        }
    }

    #[test]
    fn degenerate_scenes_give_a_finite_motion() {
        let mut random = Random::new(1);
        let mut plane = |z: f32| -> Vec<Point> {
            let mut side = || random.uniform(-10.0, 10.0) as f32;
            (0..500).map(|_| [side(), side(), z]).collect()
        };
        let scenes = [
            (plane(0.0), plane(0.3)),
            (vec![[1.0, 2.0, 3.0]; 100], vec![[1.0, 2.0, 3.0]; 100]),
            (vec![[1.0, 2.0, 3.0]; 100], vec![[1.5, 2.0, 2.0]; 100]),
            (plane(0.0), vec![[100.0, 50.0, 0.0]]),
            (vec![], vec![[1.0; 3]]),
            (vec![[f32::NAN; 3], [0.0; 3]], vec![[1.0; 3]]),
        ];
        for (source, target) in scenes {
            let transform = transform(&source, &target, Sites::Cells);
            let found = found(&source, &transform);
            assert!(
                found.to_homogeneous().iter().all(|value| value.is_finite()),
                "{found}"
            );
        }
    }
}
