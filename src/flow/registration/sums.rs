//! Sums over the matches of a fit: its normal equations, and what tells how certain they are.

use nalgebra::{Matrix6, SymmetricEigen, Vector6};

/// A direction is undetermined where its eigenvalue is below this share of the information about
/// all translations together, or of that of one match of two planes. Two normals are uncertain by
/// 1.4 degrees together. On some streets the weakest direction has 1%.
const FREE: f64 = 3e-4;
/// Sums over the matches: the normal equations, and what tells how certain they are.
pub(super) struct Sums {
    /// Second derivatives and gradient of half the weighted squared distances by a step of the
    /// motion, with rotations in metres at the spread of the points.
    pub(super) normal: Matrix6<f64>,
    pub(super) gradient: Vector6<f64>,
    /// Squares of the gradients of groups of neighboring matches.
    pub(super) scatter: Matrix6<f64>,
    /// The same where each match is off by the deviation of its surfels' points.
    pub(super) noise: Matrix6<f64>,
    /// Weighted information about translations, summed over all directions.
    pub(super) held: f64,
}

impl Default for Sums {
    fn default() -> Self {
        Self {
            normal: Matrix6::zeros(),
            gradient: Vector6::zeros(),
            scatter: Matrix6::zeros(),
            noise: Matrix6::zeros(),
            held: 0.0,
        }
    }
}

impl Sums {
    /// The sums over all `parts`, added in their order.
    pub(super) fn total(parts: &[Self]) -> Self {
        let mut all = Self::default();
        for part in parts {
            all.normal += part.normal;
            all.gradient += part.gradient;
            all.scatter += part.scatter;
            all.noise += part.noise;
            all.held += part.held;
        }
        all
    }

    /// The eigenvalue of the normal equations up to which a direction is undetermined.
    pub(super) fn undetermined(&self) -> f64 {
        FREE * self.held.max(1.0)
    }

    /// The step that minimizes the weighted, linearized squared distances, metres (rotations in
    /// metres at the points' spread). Components along undetermined directions are left out.
    pub(super) fn update(&self) -> Vector6<f64> {
        let SymmetricEigen {
            eigenvalues,
            eigenvectors,
        } = self.normal.symmetric_eigen();
        let mut update = Vector6::zeros();
        for (axis, &eigenvalue) in eigenvectors.column_iter().zip(&eigenvalues) {
            if eigenvalue > self.undetermined() {
                update -= axis * (axis.dot(&self.gradient) / eigenvalue);
            }
        }
        update
    }
}
