//! Confidence of a point's flow: the probability that its end-point error is below
//! [`CONFIDENT_WITHIN_M`].
//!
//! Logistic regressions on the features: one for moving points, one for static points and one for
//! ground. They are fitted to labelled and simulated pairs (`benches/accuracy/confidence.rs`,
//! `docs/experiments/confidence.md`).

use super::features::ConfidenceFeatures;

/// End-point error below which a flow counts as correct, metres. It is the absolute threshold of
/// the metric Acc5.
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
    /// The 12 inputs of the logistic regression, without units and scaled to the order of one. In
    /// this order, with the fields of this type and lengths in metres:
    ///
    /// - the constant 1,
    /// - `ln(1 + range_m / 10)`,
    /// - `off_m / 0.1`,
    /// - 1 if `hidden`, else 0,
    /// - `forward_m / 0.1`,
    /// - `backward_m / 0.1`,
    /// - `1 / sqrt(points)`, with at least one point,
    /// - `refused_m / 0.1`,
    /// - `1 - together`,
    /// - `ln(1 + extent_m[0])`,
    /// - the square of that,
    /// - `min(extent_m[1], 3) / 3`.
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
    /// [`CONFIDENT_WITHIN_M`]. It is a logistic regression on [`Self::features`], with separate
    /// weights for moving and static points. The weights are fitted by
    /// `benches/accuracy/confidence.rs`; see `docs/experiments/confidence.md`.
    pub fn confidence(&self) -> f32 {
        let weights = if self.moves { &MOVING } else { &STANDING };
        chance(weights, &self.features())
    }
}

/// The probability, 0 to 1, that the end-point error of a ground point is below
/// [`CONFIDENT_WITHIN_M`]. The flow of the point is the ego motion alone. `range_m` is its
/// horizontal distance from the origin of the target's frame, metres.
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
