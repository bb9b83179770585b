//! Two probabilities of a point: its confidence, which is the probability that its end-point error is
//! below [`CONFIDENT_WITHIN_M`], and the probability that it moves by at least
//! [`crate::flow::DYNAMIC_M`].
//!
//! Logistic regressions on the same features, for each probability one of moving points, one of static
//! points and one of ground. They are fitted to labelled and simulated pairs
//! (`benches/accuracy/confidence.rs`, `docs/experiments/confidence.md`).

use super::features::ConfidenceFeatures;

/// End-point error below which a flow counts as correct, metres. It is the absolute threshold of
/// the metric Acc5.
pub const CONFIDENT_WITHIN_M: f32 = 0.05;

/// Number of features.
const FEATURES: usize = 13;

/// Weights of the logistic regressions of one probability. Features beyond the weights are not used.
struct Weights {
    /// Of moving points, in the order of [`ConfidenceFeatures::features`].
    moving: &'static [f32],
    /// Of static points, in the same order.
    standing: &'static [f32],
    /// Of ground, which gets the ego motion alone: of the constant, and of [`range`].
    ground: [f32; 2],
}

/// Weights of the confidence. It does not use the displacement.
const WITHIN: Weights = Weights {
    moving: &[
        6.090, 0.710, -0.379, 0.340, -4.731, -3.398, -11.741, 0.000, 9.903, 0.619, -0.195, -4.113,
    ],
    standing: &[
        3.015, -0.347, -0.085, -0.186, -1.031, 1.102, 1.412, -0.402, -2.539, 0.708, 0.529, 1.307,
    ],
    ground: [5.792, -0.522],
};

/// Weights of the probability that a point moves.
const MOVES: Weights = Weights {
    moving: &[
        1.558, 1.855, 0.016, 0.002, -1.936, -9.556, -9.700, 0.000, 1.107, 3.667, -1.624, -6.284,
        5.095,
    ],
    standing: &[
        -3.015, 0.347, 0.085, 0.186, 1.031, -1.102, -1.412, 0.402, 2.539, -0.708, -0.529, -1.307,
        0.000,
    ],
    ground: [-5.792, 0.522],
};

/// The two probabilities of a point, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probabilities {
    /// The probability that the end-point error of the point's flow is below
    /// [`CONFIDENT_WITHIN_M`].
    pub confidence: f32,
    /// The probability that the point is displaced by at least [`crate::flow::DYNAMIC_M`], ego
    /// motion taken out.
    pub moving: f32,
}

impl Probabilities {
    /// The probabilities of a point that was taken for ground, whose flow is the ego motion alone. It
    /// moves if it is of an object that the segmentation of the ground took in. `range_m` is its
    /// horizontal distance from the origin of the target's frame, metres.
    pub fn of_ground(range_m: f32) -> Self {
        let features = [1.0, range(range_m)];
        Self {
            confidence: probability(&WITHIN.ground, &features),
            moving: probability(&MOVES.ground, &features),
        }
    }
}

impl ConfidenceFeatures {
    /// The 13 inputs of the logistic regression, without units and scaled to the order of one. In
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
    /// - `min(extent_m[1], 3) / 3`,
    /// - `ln(1 + displacement_m / 0.1)`.
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
            (1.0 + self.displacement_m / DISTANCE_M).ln(),
        ]
    }

    /// The probabilities of the point: logistic regressions on [`Self::features`], with separate weights
    /// for moving and static points. The weights are fitted by `benches/accuracy/confidence.rs`; see
    /// `docs/experiments/confidence.md`.
    pub fn probabilities(&self) -> Probabilities {
        let features = self.features();
        let weights = |of: &Weights| if self.moves { of.moving } else { of.standing };
        Probabilities {
            confidence: probability(weights(&WITHIN), &features),
            moving: probability(weights(&MOVES), &features),
        }
    }
}

/// Logarithmic scale of ranges.
fn range(range_m: f32) -> f32 {
    (1.0 + range_m / 10.0).ln()
}

/// Logistic function of the weighted sum of the features.
fn probability(weights: &[f32], features: &[f32]) -> f32 {
    let sum: f32 = weights.iter().zip(features).map(|(w, f)| w * f).sum();
    1.0 / (1.0 + (-sum).exp())
}
