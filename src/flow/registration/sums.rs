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

/// The solution of normal equations along their axes.
pub(super) struct Solved {
    /// Orthonormal axes, one a column.
    pub(super) axes: Matrix6<f64>,
    /// The information about each axis.
    pub(super) eigenvalues: Vector6<f64>,
    /// Whether the matches determine each axis. If not, nothing is known about it.
    pub(super) determined: [bool; 6],
    /// The step along each axis; zero along undetermined ones.
    pub(super) best: Vector6<f64>,
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

    /// The axes of the normal equations, and the step along them that minimizes the weighted,
    /// linearized squared distances.
    pub(super) fn solved(&self) -> Solved {
        let SymmetricEigen {
            eigenvalues,
            eigenvectors: axes,
        } = self.normal.symmetric_eigen();
        let determined = core::array::from_fn(|i| eigenvalues[i] > self.undetermined());
        let best = Vector6::from_fn(|i, _| match determined[i] {
            true => -axes.column(i).dot(&self.gradient) / eigenvalues[i],
            false => 0.0,
        });
        Solved {
            axes,
            eigenvalues,
            determined,
            best,
        }
    }
}

impl Solved {
    /// The step, metres (rotations in metres at the points' spread).
    pub(super) fn step(&self) -> Vector6<f64> {
        self.axes * self.best
    }
}
