//! Motion at constant velocity, on a screw.

use nalgebra::{Matrix3, Translation3, UnitQuaternion, Vector3};

use super::point::RigidTransform;

/// The motion of a sensor at constant velocity.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Screw {
    /// Rotation vector of the whole motion, radians.
    turn: Vector3<f64>,
    /// Velocity of the origin in the moving frame, times the duration of the motion, metres.
    way: Vector3<f64>,
}

impl Screw {
    /// The screw of a motion: its logarithm.
    pub(crate) fn of(motion: &RigidTransform) -> Self {
        let turn = motion.rotation.scaled_axis();
        let moved = motion.translation.vector;
        let inverse = left_jacobian(&turn).try_inverse();
        Self {
            turn,
            way: inverse.map_or(moved, |inverse| inverse * moved),
        }
    }

    /// The motion in a share of the duration: an exponential.
    pub(crate) fn at(&self, share: f64) -> RigidTransform {
        let turn = self.turn * share;
        RigidTransform::from_parts(
            Translation3::from(left_jacobian(&turn) * self.way * share),
            UnitQuaternion::from_scaled_axis(turn),
        )
    }
}

/// The left Jacobian of SO(3) at a rotation vector. It takes the velocity of a screw to its
/// displacement.
fn left_jacobian(turn: &Vector3<f64>) -> Matrix3<f64> {
    /// Angle below which the series are exact in double precision, radians.
    const SMALL: f64 = 1e-4;
    let cross = turn.cross_matrix();
    let angle = turn.norm();
    let [linear, square] = if angle < SMALL {
        [0.5 - angle * angle / 24.0, 1.0 / 6.0]
    } else {
        let cube = angle * angle * angle;
        [
            (1.0 - angle.cos()) / (angle * angle),
            (angle - angle.sin()) / cube,
        ]
    };
    Matrix3::identity() + cross * linear + cross * cross * square
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_screw_at_its_end_is_the_motion_and_halves_make_the_whole() {
        for turn in [[0.0; 3], [1e-6, 0.0, 2e-6], [0.1, -0.2, 0.7]] {
            let motion = RigidTransform::new(Vector3::new(3.0, -0.5, 0.2), Vector3::from(turn));
            let screw = Screw::of(&motion);
            let halves = screw.at(0.5) * screw.at(0.5);
            for whole in [screw.at(1.0), halves] {
                let off = motion.inv_mul(&whole);
                assert!(off.translation.vector.norm() < 1e-12, "{turn:?}: {off}");
                assert!(off.rotation.angle() < 1e-12, "{turn:?}: {off}");
            }
        }
    }
}
