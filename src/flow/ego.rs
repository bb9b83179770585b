//! Ego motion: the rigid motion that carries most source points onto the target.
//!
//! Gauss-Newton on the distance transform with a redescending weight (Geman and McClure) whose
//! scale shrinks from a metre to a cell, so that movers and occluded points lose their say. Needs
//! no correspondences. Knows only the transform, never the target's points.

use nalgebra::{Isometry3, Matrix6, Point3, Vector3, Vector6};

use super::distance::DistanceTransform;
use super::points::{Point, RigidTransform};

/// Points that are looked at: enough for millimetres, few enough for milliseconds.
const SAMPLED: usize = 8192;
/// Steps at most.
const STEPS: usize = 20;
/// Steps over which the weight's scale shrinks.
const SHRINKING_STEPS: usize = 13;
/// Scale of the weight at the first step, metres.
const FIRST_SCALE_M: f64 = 1.0;
/// Scale of the weight at the end, metres: one cell of the published grid.
const LAST_SCALE_M: f64 = 0.1;
/// A step shorter than this, in metres and radians, is the last.
const STEP_TOLERANCE: f64 = 1e-5;
/// Keeps the normal equations solvable where the scene leaves a direction free.
const DAMPING: f64 = 1e-6;

/// The motion target_from_source that aligns `source` with the transform's target.
pub fn align(source: &[Point], distance: &DistanceTransform) -> RigidTransform {
    let stride = source.len().div_ceil(SAMPLED).max(1);
    let points: Vec<Point3<f64>> = source
        .iter()
        .step_by(stride)
        .map(|p| Point3::from(p.map(f64::from)))
        .collect();
    let mut target_from_source = RigidTransform::identity();
    for step in 0..STEPS {
        let shrunk = (step as f64 / SHRINKING_STEPS as f64).min(1.0);
        let scale = FIRST_SCALE_M * (LAST_SCALE_M / FIRST_SCALE_M).powf(shrunk);
        let Some(update) = gauss_newton_step(&points, &target_from_source, distance, scale) else {
            break;
        };
        let translation = Vector3::new(update[0], update[1], update[2]);
        let rotation = Vector3::new(update[3], update[4], update[5]);
        target_from_source = Isometry3::new(translation, rotation) * target_from_source;
        if shrunk == 1.0 && update.norm() < STEP_TOLERANCE {
            break;
        }
    }
    target_from_source
}

/// The update (translation, rotation vector) that minimizes the weighted, linearized distances.
fn gauss_newton_step(
    points: &[Point3<f64>],
    target_from_source: &RigidTransform,
    distance: &DistanceTransform,
    scale: f64,
) -> Option<Vector6<f64>> {
    let mut normal = Matrix6::identity() * DAMPING;
    let mut gradient = Vector6::zeros();
    for point in points {
        let moved = target_from_source * point;
        let sample = distance.sample([moved.x as f32, moved.y as f32, moved.z as f32]);
        let residual = f64::from(sample.distance);
        let slope = Vector3::from(sample.gradient.map(f64::from));
        let turning = moved.coords.cross(&slope);
        let jacobian = Vector6::new(slope.x, slope.y, slope.z, turning.x, turning.y, turning.z);
        let weight = (scale * scale / (scale * scale + residual * residual)).powi(2);
        normal += jacobian * jacobian.transpose() * weight;
        gradient += jacobian * (weight * residual);
    }
    normal.cholesky().map(|factors| factors.solve(&-gradient))
}
