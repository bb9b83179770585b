//! The most probable motion: the evidence of the matches, weighed against how vehicles move.
//!
//! The normal equations of a fit do not say how certain its motion is. Their residuals do: the
//! covariance of the evidence is the sandwich estimator `A^-1 (B + N) A^-1`, with the normal
//! equations `A`, the scatter `B` of the gradients of groups of neighboring matches, and the noise
//! `N` that the thickness of the surfels accounts for. Information is the inverse of a covariance.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use super::sums::{Solved, Sums};
use crate::flow::data::RigidTransform;

/// Share of the variance of the points of a surfel, along its normal, that one match is off by.
const NOISE_SHARE: f64 = 0.1;
/// Least variance of the evidence along an axis, square metres: it keeps the inverse finite.
const LEAST_VARIANCE: f64 = 1e-10;

/// Standard deviations of the motion of a vehicle about the prior: the rise of the sensor, metres,
/// and its part of the distance driven; pitch and roll, radians. In 0.1 s a car of KITTI rises by
/// 0.008 m, rolls by 0.17 degrees and pitches by 0.25.
const RISE_M: f64 = 0.015;
const SLOPE: f64 = 0.015;
const TILT: f64 = 0.3 / 180.0 * std::f64::consts::PI;
/// The same along the ground, where vehicles move as they like: metres, and yaw in radians.
const DRIVE_M: f64 = 3.0;
const TURN: f64 = 10.0 / 180.0 * std::f64::consts::PI;
/// Deviations beyond this number of standard deviations pull no harder (Huber): a jump of the sensor
/// is improbable, not impossible.
const SURPRISE: f64 = 3.0;

/// The motion that a vehicle probably has.
pub(super) struct Prior(RigidTransform);

/// The information of the matches about a step of the motion, along the axes of their normal
/// equations. Rotations are in metres at the spread of the points.
pub(super) struct Evidence {
    solved: Solved,
    information: Matrix6<f64>,
}

/// A Gaussian over steps: the most probable one, and the covariance of the motion after it.
pub(super) struct Posterior {
    /// The step: translation, then rotation in metres at the spread of the points.
    pub(super) step: Vector6<f64>,
    /// Covariance of the position of the source's origin, metres, and of the rotation, radians, in
    /// the target's frame.
    pub(super) covariance: Matrix6<f64>,
}

impl Prior {
    /// The motion of a vehicle: probably near `motion` across the ground and in its tilt.
    pub(super) fn of_vehicle(motion: &RigidTransform) -> Self {
        Self(*motion)
    }

    /// Deviation of `motion` from the prior: that of the position of the source's origin, metres,
    /// and the rotation, radians.
    pub(super) fn deviation(&self, motion: &RigidTransform) -> Vector6<f64> {
        let shift = motion.translation.vector - self.0.translation.vector;
        let turn = (motion.rotation * self.0.rotation.inverse()).scaled_axis();
        Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
    }

    /// Information about the six components of a deviation.
    fn information(&self, deviation: &Vector6<f64>, motion: &RigidTransform) -> Vector6<f64> {
        let driven_m = motion.translation.vector.norm();
        let rise_m = RISE_M.hypot(SLOPE * driven_m);
        let sigma = Vector6::new(DRIVE_M, DRIVE_M, rise_m, TILT, TILT, TURN);
        sigma.zip_map(deviation, |sigma, off| {
            let surprise = (SURPRISE * sigma / off.abs()).min(1.0);
            surprise / (sigma * sigma)
        })
    }
}

impl Evidence {
    pub(super) fn of(sums: &Sums) -> Self {
        let solved = sums.solved();
        let Solved {
            axes,
            eigenvalues,
            determined,
            ..
        } = &solved;
        let free = sums.undetermined();
        // Part of the information along each axis that is not due to uncertain normals.
        let real = eigenvalues.map(|value| 1.0 - free / value.max(free));
        let spread = sums.scatter + sums.noise * NOISE_SHARE;
        let spread = axes.transpose() * spread * axes;
        let covariance = Matrix6::from_fn(|i, j| {
            let variance = if i == j { LEAST_VARIANCE } else { 0.0 };
            match determined[i] && determined[j] {
                true => variance + spread[(i, j)] / (eigenvalues[i] * eigenvalues[j]),
                false => variance,
            }
        });
        let inverse = covariance.try_inverse().unwrap_or_else(Matrix6::zeros);
        let shared = real * real.transpose();
        Self {
            information: inverse.zip_map(&shared, |value, real| value * real.sqrt()),
            solved,
        }
    }

    /// The step from `motion` to the most probable motion. Steps rotate about `center`, in the
    /// target's frame, and `spread_m` scales their rotations to metres. A step has no component
    /// along undetermined axes: the normals are not exact, and a pull of the prior along other axes
    /// would move them. None where numbers are not finite.
    pub(super) fn with(
        &self,
        prior: &Prior,
        motion: &RigidTransform,
        center: Vector3<f64>,
        spread_m: f64,
    ) -> Option<Posterior> {
        let Solved {
            axes,
            determined,
            best,
            ..
        } = &self.solved;
        // Takes a step to what it adds to the deviation.
        let arm = motion.translation.vector - center;
        let mut deviating = Matrix6::identity();
        let turning = arm.cross_matrix() / -spread_m;
        deviating.fixed_view_mut::<3, 3>(0, 3).copy_from(&turning);
        let scaled = Matrix3::identity() / spread_m;
        deviating.fixed_view_mut::<3, 3>(3, 3).copy_from(&scaled);
        let deviating = deviating * axes;

        let deviation = prior.deviation(motion);
        let known = prior.information(&deviation, motion);
        let backward = deviating.transpose();
        let mut belief = backward * Matrix6::from_diagonal(&known) * deviating;
        let mut pull = self.information * best;
        pull -= backward * deviation.component_mul(&known);
        for i in 0..6 {
            for j in 0..6 {
                if determined[i] != determined[j] {
                    belief[(i, j)] = 0.0;
                }
            }
            if !determined[i] {
                pull[i] = 0.0;
            }
        }
        let inverse = (self.information + belief).try_inverse()?;
        let step = axes * (inverse * pull);
        let covariance = deviating * inverse * backward;
        let is_finite = step.iter().all(|value| value.is_finite());
        is_finite.then(|| Posterior {
            step,
            covariance: (covariance + covariance.transpose()) / 2.0,
        })
    }
}
