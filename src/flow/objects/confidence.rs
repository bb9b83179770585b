//! Confidence of a point's flow: the probability that its end-point error is below [`CONFIDENT_WITHIN_M`].
//!
//! Logistic regressions on the features: one for moving points, one for static points and one for
//! ground. They are fitted to labelled and simulated pairs (`benches/accuracy/confidence.rs`,
//! `docs/experiments/confidence.md`).

use super::features::ConfidenceFeatures;

/// End-point error below which a flow counts as correct, metres: the threshold of the metric Acc5.
pub const CONFIDENT_WITHIN_M: f32 = 0.05;

/// Number of features.
const FEATURES: usize = 12;

/// Weights for moving points, in the order of [`ConfidenceFeatures::features`].
const MOVING: [f32; FEATURES] = [
    6.090, 0.710, -0.379, 0.340, -4.731, -3.398, -11.741, 0.000, 9.903, 0.619, -0.195, -4.113,
];
/// Weights for static points, in the same order.
const STANDING: [f32; FEATURES] = [
    3.015, -0.347, -0.085, -0.186, -1.031, 1.102, 1.412, -0.402, -2.539, 0.708, 0.529, 1.307,
];
/// Weights for ground, which gets the ego motion alone: of the constant, and of [`range`].
const GROUND: [f32; 2] = [5.792, -0.522];

impl ConfidenceFeatures {
    /// The 12 features of the regression, each of the order of one: the constant 1, the logarithmic
    /// range, the residual, whether the target has no point there, the forward and the backward
    /// cost of the cluster, one over the square root of its points, the cost reduction of a
    /// rejected hypothesis, the share of the cluster assigned otherwise, the logarithm of its
    /// length, the square of that, and its height. The size matters because cars are neither as
    /// small as posts nor as large as walls.
    pub fn features(&self) -> [f32; FEATURES] {
        /// Distance that is scaled to one, metres.
        const DISTANCE_M: f32 = 0.1;
        /// Height that is scaled to one, metres. Cars are lower; all higher clusters count alike,
        /// as buildings.
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

    /// The probability, 0 to 1, that the end-point error of the point's flow is below
    /// [`CONFIDENT_WITHIN_M`]: a logistic regression on the features, with separate weights for moving
    /// and static points. The weights are fitted by `benches/accuracy/confidence.rs`; see
    /// `docs/experiments/confidence.md`.
    pub fn confidence(&self) -> f32 {
        let weights = if self.moves { &MOVING } else { &STANDING };
        chance(weights, &self.features())
    }
}

/// The probability, 0 to 1, that the flow of a ground point is less than [`CONFIDENT_WITHIN_M`] off where it
/// gets the ego motion alone. `range_m` is its horizontal distance from the origin of the target's
/// frame, metres.
pub fn confidence_of_ground(range_m: f32) -> f32 {
    chance(&GROUND, &[1.0, range(range_m)])
}

/// Logarithmic scale of ranges.
fn range(range_m: f32) -> f32 {
    (1.0 + range_m / 10.0).ln()
}

/// Logistic function of the weighted sum of the features.
fn chance(weights: &[f32], features: &[f32]) -> f32 {
    let sum: f32 = weights.iter().zip(features).map(|(w, f)| w * f).sum();
    1.0 / (1.0 + (-sum).exp())
}
