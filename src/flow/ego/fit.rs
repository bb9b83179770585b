//! Gauss-Newton on the distances of points to the planes of the surfels nearest to them.
//!
//! The weight (Geman and McClure) and the reach of a match shrink on the way, so that movers and
//! what only one sweep saw lose their say. Directions that the matches leave free are not moved
//! along. It must not know where a fit starts, or why.

use nalgebra::{
    Isometry3, Matrix6, Point3, SymmetricEigen, Translation3, UnitQuaternion, Vector3, Vector6,
};
use rayon::prelude::*;

use super::surfels::Surfels;
use crate::flow::points::{Point, RigidTransform};
use crate::flow::watch::Watch;

/// Points whose sums one thread takes at a time; sums are added in the points' order.
const POINTS_AT_ONCE: usize = 256;
/// Reach and scale shrink over this share of the steps.
const SHRINKING: f64 = 0.5;
/// A step shorter than this, metres at the points' spread, is the last.
const SHORT_STEP_M: f64 = 2e-4;
/// A direction is free where it moves the points along their normals by less than this share,
/// squared, of its length: normals are 3 degrees uncertain. Some streets are held by 1%.
const FREE: f64 = 3e-3;
/// The least spread of points that turns are measured by, metres.
const LEAST_SPREAD_M: f64 = 1e-3;

/// How a fit goes from coarse to fine: at its first step, and at its last.
pub(super) struct Schedule {
    /// Steps at most.
    pub(super) steps: usize,
    /// Matches are sought within this, metres.
    pub(super) within_m: [f32; 2],
    /// Scale of the weight, metres.
    pub(super) scale_m: [f64; 2],
}

impl Schedule {
    /// Reach and scale at a step, and whether they have shrunk to their last.
    fn at(&self, step: usize) -> (f32, f64, bool) {
        let share = step as f64 / ((self.steps - 1) as f64 * SHRINKING).max(1.0);
        let share = share.min(1.0);
        let ([far, near], [wide, narrow]) = (self.within_m, self.scale_m);
        (
            far * (near / far).powf(share as f32),
            wide * (narrow / wide).powf(share),
            share >= 1.0,
        )
    }
}

/// Points, and the surfels that they are fitted to.
pub(super) struct Fit<'a> {
    points: &'a [Point],
    surfels: &'a Surfels,
    /// The points' middle, about which turns are taken, and their root-mean-square distance from
    /// it, which makes turns and shifts comparable.
    center: Point3<f64>,
    spread_m: f64,
}

/// What the matches say together.
struct Sums {
    normal: Matrix6<f64>,
    gradient: Vector6<f64>,
    weight: f64,
}

impl<'a> Fit<'a> {
    pub(super) fn new(points: &'a [Point], surfels: &'a Surfels) -> Self {
        let count = points.len().max(1) as f64;
        let sum: Vector3<f64> = points.iter().map(|&point| double(point).coords).sum();
        let center = Point3::from(sum / count);
        let square = |&point: &Point| (double(point) - center).norm_squared();
        let spread_m = (points.iter().map(square).sum::<f64>() / count).sqrt();
        Self {
            points,
            surfels,
            center,
            spread_m: spread_m.max(LEAST_SPREAD_M),
        }
    }

    /// The motion that a fit from `start` ends at; the motion so far where the watch interrupts.
    pub(super) fn run(
        &self,
        start: &RigidTransform,
        schedule: &Schedule,
        watch: &dyn Watch,
    ) -> RigidTransform {
        let mut motion = *start;
        for step in 0..schedule.steps {
            if watch.interrupt().is_some() {
                break;
            }
            let (within_m, scale_m, shrunk) = schedule.at(step);
            let update = self.sums(&motion, within_m, scale_m).update();
            let [x, y, z, a, b, c] = update.into();
            let turn = UnitQuaternion::new(Vector3::new(a, b, c) / self.spread_m);
            let turn = Isometry3::rotation_wrt_point(turn, motion * self.center);
            motion = Translation3::new(x, y, z) * turn * motion;
            if shrunk && update.norm() < SHORT_STEP_M {
                break;
            }
        }
        motion
    }

    /// How well a motion fits, 0 to 1: the share of the points that lie on surfels, by weight.
    pub(super) fn score(&self, motion: &RigidTransform, schedule: &Schedule) -> f64 {
        let (within_m, scale_m, _) = schedule.at(schedule.steps);
        self.sums(motion, within_m, scale_m).weight / self.points.len().max(1) as f64
    }

    fn sums(&self, motion: &RigidTransform, within_m: f32, scale_m: f64) -> Sums {
        let chunks = self.points.par_chunks(POINTS_AT_ONCE);
        let sums: Vec<Sums> = chunks
            .map(|points| self.sums_of(points, motion, within_m, scale_m))
            .collect();
        let mut all = Sums::default();
        for sums in sums {
            all.normal += sums.normal;
            all.gradient += sums.gradient;
            all.weight += sums.weight;
        }
        all
    }

    fn sums_of(
        &self,
        points: &[Point],
        motion: &RigidTransform,
        within_m: f32,
        scale_m: f64,
    ) -> Sums {
        let pivot = motion * self.center;
        let mut sums = Sums::default();
        for &point in points {
            let moved = motion * double(point);
            let single = moved.map(|c| c as f32).into();
            let Some(surfel) = self.surfels.nearest(single, within_m) else {
                continue;
            };
            let normal = Vector3::from(surfel.normal.map(f64::from));
            let residual = normal.dot(&(moved - double(surfel.point)));
            let square = scale_m * scale_m;
            let weight = (square / (square + residual * residual)).powi(2);
            let turning = (moved - pivot).cross(&normal) / self.spread_m;
            let [x, y, z] = normal.into();
            let jacobian = Vector6::new(x, y, z, turning.x, turning.y, turning.z);
            sums.normal += jacobian * jacobian.transpose() * weight;
            sums.gradient += jacobian * (weight * residual);
            sums.weight += weight;
        }
        sums
    }
}

impl Default for Sums {
    fn default() -> Self {
        Self {
            normal: Matrix6::zeros(),
            gradient: Vector6::zeros(),
            weight: 0.0,
        }
    }
}

impl Sums {
    /// The step that minimizes the weighted, linearized distances, metres (turns in metres at the
    /// points' spread), without what would move along free directions.
    fn update(&self) -> Vector6<f64> {
        let SymmetricEigen {
            eigenvalues,
            eigenvectors,
        } = self.normal.symmetric_eigen();
        let mut update = Vector6::zeros();
        for (axis, &held) in eigenvectors.column_iter().zip(&eigenvalues) {
            if held > FREE * self.weight.max(1.0) {
                update -= axis * (axis.dot(&self.gradient) / held);
            }
        }
        update
    }
}

fn double(point: Point) -> Point3<f64> {
    Point3::from(point.map(f64::from))
}
