//! Gauss-Newton on the distances of surfels to the surfels nearest to them (generalized ICP, Segal
//! et al., 2009).
//!
//! A surfel is thin along its normal and wide across it, and so a match is as sure of a direction
//! as both surfels are: two that face one another measure along their normal, and two that do not
//! hardly measure. The weight (Geman and McClure) and the reach of a match shrink on the way, so
//! that movers and what only one sweep saw lose their say. Directions that the matches leave free
//! are not moved along. It must not know where a fit starts, or why.

use nalgebra::{
    Isometry3, Matrix3, Matrix6, Point3, SymmetricEigen, Translation3, UnitQuaternion, Vector3,
    Vector6,
};
use rayon::prelude::*;

use super::surfels::{AllSurfels, Surfel};
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::spatial::PlaneFit;

/// Surfels whose sums one thread takes at a time; sums are added in the surfels' order.
const AT_ONCE: usize = 256;
/// Reach and scale shrink over this share of the steps.
const SHRINKING: f64 = 0.5;
/// Variance of a perfect plane along its normal, that across being 1, and how much of a surfel's
/// thickness is added to it: normals are 2 degrees uncertain at best, and more on what is thick.
const THIN: f64 = 1e-3;
const THICKNESS: f64 = 0.1;
/// A step shorter than this, metres at the points' spread, is the last.
const SHORT_STEP_M: f64 = 2e-4;
/// A direction is free where the matches hold it by less than this share of what they hold of all
/// shifts together, or of what one match of two planes does: normals are 1.4 degrees uncertain
/// together. Some streets are held by 1%.
const FREE: f64 = 3e-4;
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

/// Surfels, and those that they are fitted to.
pub(super) struct Fit<'a> {
    source: &'a [Surfel],
    target: AllSurfels<'a>,
    /// The source's middle, about which turns are taken, and its root-mean-square distance from
    /// it, which makes turns and shifts comparable.
    center: Point3<f64>,
    spread_m: f64,
}

/// What the matches say together.
struct Sums {
    normal: Matrix6<f64>,
    gradient: Vector6<f64>,
    /// How much they hold of shifts, in all directions together.
    held: f64,
}

impl<'a> Fit<'a> {
    pub(super) fn new(source: &'a [Surfel], target: AllSurfels<'a>) -> Self {
        let count = source.len().max(1) as f64;
        let points = source.iter().map(|surfel| double(surfel.point));
        let sum: Vector3<f64> = points.clone().map(|point| point.coords).sum();
        let center = Point3::from(sum / count);
        let squares = points.map(|point| (point - center).norm_squared());
        let spread_m = (squares.sum::<f64>() / count).sqrt();
        Self {
            source,
            target,
            center,
            spread_m: spread_m.max(LEAST_SPREAD_M),
        }
    }

    /// The motion that a fit from `start` ends at; the motion so far where the watch interrupts.
    pub(super) fn run(
        &self,
        start: &RigidTransform,
        schedule: &Schedule,
        control: &dyn Control,
    ) -> RigidTransform {
        let mut motion = *start;
        for step in 0..schedule.steps {
            if control.interrupt().is_some() {
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

    /// How well a motion fits, 0 to 1: what its matches hold of shifts, a surfel; 1 where all lie on
    /// perfect planes that they face.
    pub(super) fn score(&self, motion: &RigidTransform, schedule: &Schedule) -> f64 {
        let (within_m, scale_m, _) = schedule.at(schedule.steps);
        self.sums(motion, within_m, scale_m).held / self.source.len().max(1) as f64
    }

    fn sums(&self, motion: &RigidTransform, within_m: f32, scale_m: f64) -> Sums {
        let chunks = self.source.par_chunks(AT_ONCE);
        let sums: Vec<Sums> = chunks
            .map(|surfels| self.sums_of(surfels, motion, within_m, scale_m))
            .collect();
        let mut all = Sums::default();
        for sums in sums {
            all.normal += sums.normal;
            all.gradient += sums.gradient;
            all.held += sums.held;
        }
        all
    }

    fn sums_of(
        &self,
        surfels: &[Surfel],
        motion: &RigidTransform,
        within_m: f32,
        scale_m: f64,
    ) -> Sums {
        let pivot = motion * self.center;
        let rotation = motion.rotation.to_rotation_matrix();
        let mut sums = Sums::default();
        for surfel in surfels {
            let moved = motion * double(surfel.point);
            let single = moved.map(|c| c as f32).into();
            let Some(nearest) = self.target.nearest(single, within_m) else {
                continue;
            };
            let (source, target) = (normal(&surfel.flat), normal(&nearest.flat));
            let source = covariance(&surfel.flat, &(rotation * source));
            let Some(inverse) = (source + covariance(&nearest.flat, &target)).try_inverse() else {
                continue;
            };
            // Two perfect planes that face one another count as what they are along their normal
            // and not at all across it.
            let information = inverse * (2.0 * THIN) - Matrix3::identity() * THIN;
            let residual = moved - double(nearest.point);
            let pull = information * residual;
            let square = scale_m * scale_m;
            let weight = (square / (square + residual.dot(&pull))).powi(2);
            let turning = (moved - pivot).cross_matrix() / -self.spread_m;
            let across = information * turning;
            let mut block = Matrix6::zeros();
            block.fixed_view_mut::<3, 3>(0, 0).copy_from(&information);
            block.fixed_view_mut::<3, 3>(0, 3).copy_from(&across);
            block
                .fixed_view_mut::<3, 3>(3, 0)
                .copy_from(&across.transpose());
            block
                .fixed_view_mut::<3, 3>(3, 3)
                .copy_from(&(turning.transpose() * across));
            let [x, y, z] = pull.into();
            let [a, b, c] = (turning.transpose() * pull).into();
            sums.normal += block * weight;
            sums.gradient += Vector6::new(x, y, z, a, b, c) * weight;
            sums.held += information.trace() * weight;
        }
        sums
    }
}

impl Default for Sums {
    fn default() -> Self {
        Self {
            normal: Matrix6::zeros(),
            gradient: Vector6::zeros(),
            held: 0.0,
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
        for (axis, &hold) in eigenvectors.column_iter().zip(&eigenvalues) {
            if hold > FREE * self.held.max(1.0) {
                update -= axis * (axis.dot(&self.gradient) / hold);
            }
        }
        update
    }
}

/// The covariance of a surfel with that normal: 1 across, thin along.
fn covariance(flat: &PlaneFit, normal: &Vector3<f64>) -> Matrix3<f64> {
    let along = THIN + THICKNESS * f64::from(flat.thickness);
    Matrix3::identity() - normal * normal.transpose() * (1.0 - along)
}

fn normal(flat: &PlaneFit) -> Vector3<f64> {
    Vector3::from(flat.normal.map(f64::from))
}

fn double(point: Point) -> Point3<f64> {
    Point3::from(point.map(f64::from))
}
