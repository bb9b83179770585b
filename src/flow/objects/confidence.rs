//! How sure a point's motion is: the chance that it is less than [`SURE_M`] off.
//!
//! Logistic regressions on the evidence, one for what moves, one for what stands still and one for
//! ground, fitted to labelled and simulated pairs (`examples/confidence.rs`, `docs/numerics.md`).

use super::features::ConfidenceFeatures;

/// An end-point error below this is right, metres: that of the metric Acc5.
pub const SURE_M: f32 = 0.05;

/// What is weighed.
const FEATURES: usize = 12;

/// Weights of what moves, in the order of [`ConfidenceFeatures::features`].
const MOVING: [f32; FEATURES] = [
    6.090, 0.710, -0.379, 0.340, -4.731, -3.398, -11.741, 0.000, 9.903, 0.619, -0.195, -4.113,
];
/// Weights of what stands still.
const STANDING: [f32; FEATURES] = [
    3.015, -0.347, -0.085, -0.186, -1.031, 1.102, 1.412, -0.402, -2.539, 0.708, 0.529, 1.307,
];
/// Weights of ground, which moves with the vehicle: none, and by [`range`].
const GROUND: [f32; 2] = [5.792, -0.522];

impl ConfidenceFeatures {
    /// What is weighed, each of the order of one: 1, range, residual, whether nothing is there, the
    /// cluster's cost there and back, how few points it has, what a refused motion would have
    /// gained, how much of the cluster does otherwise, and its size: cars are neither as small as
    /// posts nor as large as walls.
    pub fn features(&self) -> [f32; FEATURES] {
        /// Metres that are one.
        const DISTANCE_M: f32 = 0.1;
        /// Cars are lower, what is higher is as good as a house.
        const HEIGHT_M: f32 = 3.0;
        let length = (1.0 + self.extent_m[0]).ln();
        [
            1.0,
            range(self.range_m),
            self.off_m / DISTANCE_M,
            f32::from(self.hidden),
            self.forward_m / DISTANCE_M,
            self.backward_m / DISTANCE_M,
            1.0 / (self.points.max(1) as f32).sqrt(),
            self.refused_m / DISTANCE_M,
            1.0 - self.together,
            length,
            length * length,
            self.extent_m[1].min(HEIGHT_M) / HEIGHT_M,
        ]
    }

    /// The chance that the motion is less than [`SURE_M`] off, 0 to 1.
    pub fn confidence(&self) -> f32 {
        let weights = if self.moves { &MOVING } else { &STANDING };
        chance(weights, &self.features())
    }
}

/// The chance that ground this far away, metres, is less than [`SURE_M`] off where it moves with
/// the vehicle.
pub fn confidence_of_ground(range_m: f32) -> f32 {
    chance(&GROUND, &[1.0, range(range_m)])
}

/// Ranges count by their logarithm.
fn range(range_m: f32) -> f32 {
    (1.0 + range_m / 10.0).ln()
}

fn chance(weights: &[f32], features: &[f32]) -> f32 {
    let sum: f32 = weights.iter().zip(features).map(|(w, f)| w * f).sum();
    1.0 / (1.0 + (-sum).exp())
}
