//! Motion of a vehicle's body on its springs: pitch, roll and heave about the pose of its wheels.
//!
//! Each is a sum of two oscillations, as of a body of 1 to 2 Hz on tyres and a seat of 2.5 to 4 Hz.
//! With the full amplitude a vehicle pitches by 0.25 degrees, rolls by 0.17 degrees and heaves by
//! 7 mm in 0.1 s (standard deviations), as the cars of KITTI do.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Vector3};

use crate::flow::data::{Random, RigidTransform};

/// Ranges of the frequencies of the two oscillations, Hz.
const FREQUENCIES_HZ: [[f64; 2]; 2] = [[1.0, 2.0], [2.5, 4.0]];
/// Amplitudes of the two oscillations of roll and pitch, radians, and of the heave, metres.
const AMPLITUDES: [[f64; 2]; 3] = [[0.0040, 0.0013], [0.0058, 0.0019], [0.009, 0.003]];
/// Range of the factor of a street on all amplitudes: from a smooth road to a rough one.
const ROUGHNESS: [f64; 2] = [0.2, 1.2];

/// The springs of one vehicle on one street.
#[derive(Debug, Clone)]
pub(super) struct Suspension {
    /// Of roll, pitch and heave.
    oscillations: [[Oscillation; 2]; 3],
}

#[derive(Debug, Clone, Copy)]
struct Oscillation {
    amplitude: f64,
    frequency_hz: f64,
    phase: f64,
}

impl Suspension {
    pub(super) fn new(random: &mut Random) -> Self {
        let roughness = random.uniform(ROUGHNESS[0], ROUGHNESS[1]);
        let mut oscillation = |amplitude: f64, [low, high]: [f64; 2]| Oscillation {
            amplitude: amplitude * roughness,
            frequency_hz: random.uniform(low, high),
            phase: random.uniform(0.0, TAU),
        };
        let [first, second] = FREQUENCIES_HZ;
        Self {
            oscillations: AMPLITUDES
                .map(|[slow, fast]| [oscillation(slow, first), oscillation(fast, second)]),
        }
    }

    /// The pose of the body in the frame of its wheels at a time, seconds.
    pub(super) fn body(&self, seconds: f64) -> RigidTransform {
        let at = |oscillation: &Oscillation| {
            let turn = TAU * oscillation.frequency_hz * seconds + oscillation.phase;
            oscillation.amplitude * turn.sin()
        };
        let [roll, pitch, heave] = self
            .oscillations
            .each_ref()
            .map(|both| both.iter().map(at).sum());
        Isometry3::new(
            Vector3::new(0.0, 0.0, heave),
            Vector3::new(roll, pitch, 0.0),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_body_moves_as_those_of_kitti_do() {
        // Of 39 steps of 0.1 s of a KITTI drive: degrees, degrees, metres.
        let measured = [0.169, 0.246, 0.0083];
        let mut squares = [0.0; 3];
        let mut steps = 0.0;
        for seed in 0..200 {
            let suspension = Suspension::new(&mut Random::new(seed));
            for step in 0..40 {
                let at = |step: i32| suspension.body(f64::from(step) * 0.1);
                let (now, next) = (at(step), at(step + 1));
                let turn = (next.rotation * now.rotation.inverse()).scaled_axis();
                let rise = next.translation.z - now.translation.z;
                let moved = [turn.x.to_degrees(), turn.y.to_degrees(), rise];
                squares = core::array::from_fn(|a| squares[a] + moved[a] * moved[a]);
                steps += 1.0;
            }
        }
        for (square, measured) in squares.iter().zip(measured) {
            let deviation: f64 = (square / steps).sqrt();
            assert!(
                (0.5..1.5).contains(&(deviation / measured)),
                "{deviation} {measured}"
            );
        }
    }
}
