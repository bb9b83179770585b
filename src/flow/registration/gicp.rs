//! Generalized ICP (GICP; Segal et al., 2009): Gauss-Newton on the distances between matched
//! surfels.
//!
//! The covariance of a surfel is thin along its normal and wide across it. The information of a
//! match comes from both surfels: two parallel ones constrain the motion along their normal, and
//! two that are not parallel hardly constrain it. The robust weight is that of Geman and McClure.
//! Its scale and the range of matches shrink during the fit, so that moving objects and surfaces
//! present in one sweep only lose their influence. The motion is not updated in directions that the
//! matches do not determine.

use nalgebra::{
    Isometry3, Matrix3, Matrix6, Point3, Translation3, UnitQuaternion, Vector3, Vector6,
};
use rayon::prelude::*;

use super::posterior::{Evidence, Posterior, Prior};
use super::sums::Sums;
use super::surfels::{Surfel, Surfels};
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::spatial::PlaneFit;

/// Surfels whose sums one thread computes at a time. The partial sums are added in the surfels'
/// order.
const AT_ONCE: usize = 256;
/// Neighboring surfels whose matches are taken to be off alike.
const GROUP: usize = 32;
/// Share of the steps over which the range and the scale shrink.
const SHRINKING: f64 = 0.5;
/// Variance of a perfect plane along its normal, where the variance across it is 1, and the factor
/// of a surfel's thickness that is added to it. Normals are uncertain by 2 degrees at best, and by
/// more on thick surfaces.
const THIN: f64 = 1e-3;
const THICKNESS: f64 = 0.1;
/// A step shorter than this is the last, metres at the points' spread.
const SHORT_STEP_M: f64 = 2e-4;
/// Bound on the z component of the normal of an upright surfel: steeper than 45 degrees.
const UPRIGHT: f32 = 0.7;
/// Least spread of the points that rotations are scaled by, metres.
const LEAST_SPREAD_M: f64 = 1e-3;

/// Schedule of a fit from coarse to fine: values at its first step and at its last.
pub(super) struct Schedule {
    /// Maximum number of steps.
    pub(super) steps: usize,
    /// Range of matches, metres.
    pub(super) within_m: [f32; 2],
    /// Scale of the robust weight, metres.
    pub(super) scale_m: [f64; 2],
}

impl Schedule {
    /// Range and scale at a step, and whether both have reached their last values.
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

/// Source surfels, and the target surfels that they are fitted to.
pub(super) struct Fit<'a> {
    source: &'a [Surfel],
    target: &'a Surfels,
    /// Centroid of the source, which is the center of rotations. The root-mean-square distance of
    /// its points from the centroid scales rotations to metres.
    center: Point3<f64>,
    spread_m: f64,
}

impl<'a> Fit<'a> {
    pub(super) fn new(source: &'a [Surfel], target: &'a Surfels) -> Self {
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

    /// The motion at the end of a fit from `start`, or the motion so far where `control`
    /// interrupts.
    pub(super) fn run(
        &self,
        start: &RigidTransform,
        schedule: &Schedule,
        control: &dyn Control,
    ) -> RigidTransform {
        self.descend(start, schedule, control, |sums, _| {
            Some(sums.solved().step())
        })
    }

    /// The most probable motion after a fit from `start`, and its covariance as in [`Posterior`].
    /// Where `control` interrupts, it is the motion so far; the covariance is none without a step.
    pub(super) fn run_with(
        &self,
        prior: &Prior,
        start: &RigidTransform,
        schedule: &Schedule,
        control: &dyn Control,
    ) -> (RigidTransform, Option<Matrix6<f64>>) {
        let mut covariance = None;
        let motion = self.descend(start, schedule, control, |sums, motion| {
            let center = (motion * self.center).coords;
            let posterior = Evidence::of(sums).with(prior, motion, center, self.spread_m)?;
            let Posterior {
                step,
                covariance: found,
            } = posterior;
            covariance = Some(found);
            Some(step)
        });
        (motion, covariance)
    }

    /// The motion after the steps of a schedule that `next` gives from the sums at a motion. It ends
    /// early after a short step, and where there is none.
    fn descend(
        &self,
        start: &RigidTransform,
        schedule: &Schedule,
        control: &dyn Control,
        mut next: impl FnMut(&Sums, &RigidTransform) -> Option<Vector6<f64>>,
    ) -> RigidTransform {
        let mut motion = *start;
        for step in 0..schedule.steps {
            if control.interrupt().is_some() {
                break;
            }
            let (within_m, scale_m, shrunk) = schedule.at(step);
            let sums = self.sums(&motion, within_m, scale_m);
            let Some(update) = next(&sums, &motion) else {
                break;
            };
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

    /// Score of a motion, 0 to 1: the information of its matches about translations, per surfel. It
    /// is 1 where every surfel lies on a perfect plane parallel to it.
    pub(super) fn score(&self, motion: &RigidTransform, schedule: &Schedule) -> f64 {
        let (within_m, scale_m, _) = schedule.at(schedule.steps);
        self.sums(motion, within_m, scale_m).held / self.source.len().max(1) as f64
    }

    /// Score of the upright source surfels alone: ground matches ground after any motion on it.
    pub(super) fn upright_score(&self, motion: &RigidTransform, schedule: &Schedule) -> f64 {
        let (within_m, scale_m, _) = schedule.at(schedule.steps);
        let is_upright = |surfel: &&Surfel| surfel.flat.normal[2].abs() < UPRIGHT;
        let upright: Vec<Surfel> = self.source.iter().filter(is_upright).copied().collect();
        self.sums_of(&upright, motion, within_m, scale_m).held / upright.len().max(1) as f64
    }

    fn sums(&self, motion: &RigidTransform, within_m: f32, scale_m: f64) -> Sums {
        let chunks = self.source.par_chunks(AT_ONCE);
        let sums: Vec<Sums> = chunks
            .map(|surfels| self.sums_of(surfels, motion, within_m, scale_m))
            .collect();
        Sums::total(&sums)
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
        let mut group = Vector6::zeros();
        for (index, surfel) in surfels.iter().enumerate() {
            if index % GROUP == 0 {
                sums.scatter += group * group.transpose();
                group.fill(0.0);
            }
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
            // Scaled and offset so that two perfect, parallel planes have full information along
            // their normal and none across it.
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
            let gradient = Vector6::new(x, y, z, a, b, c) * weight;
            let variance = f64::from(surfel.flat.variance + nearest.flat.variance);
            sums.normal += block * weight;
            sums.noise += block * (weight * weight * variance);
            sums.gradient += gradient;
            group += gradient;
            sums.held += information.trace() * weight;
        }
        sums.scatter += group * group.transpose();
        sums
    }
}

/// Covariance of a surfel with the given normal: 1 across it, thin along it.
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
