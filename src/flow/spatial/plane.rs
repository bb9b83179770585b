//! Plane fit to the neighborhood of a point, from the covariance of its points.

use nalgebra::{Matrix3, Vector3};

use super::neighborhood::Neighborhood;

/// Least number of points, the center included, for a plane.
const LEAST_POINTS: f64 = 4.0;
/// Flatness threshold: the variance along the second axis must exceed that along the normal by this
/// share of the variance along the first axis. Less flat neighborhoods are branches and wires. With
/// a higher threshold, walls hit by a single ring are lost.
const FLAT: f64 = 0.05;
/// What is added to the thickness of a plane of [`LEAST_POINTS`] points. It falls with the fifth power of
/// their number: four points of one ring around a corner lie on a plane that is no surface.
const UNCERTAIN: f32 = 1.2;
/// Variances below this count as zero, square metres.
const NO_SPREAD: f64 = 1e-12;

/// A plane fitted to points.
#[derive(Clone, Copy)]
pub(crate) struct PlaneFit {
    /// Unit normal of either sign.
    pub(crate) normal: [f32; 3],
    /// Variance along the normal over the variance along the second axis, and an addition for planes
    /// of few points: 0 for a plane of many.
    pub(crate) thickness: f32,
    /// Variance along the normal, square metres.
    pub(crate) variance: f32,
}

impl Neighborhood {
    /// The plane of the points; none where there are fewer than four, or where they do not lie on a
    /// plane.
    pub(super) fn flat(&self) -> Option<PlaneFit> {
        if self.count < LEAST_POINTS {
            return None;
        }
        let mean = Vector3::from(self.sum) / self.count;
        let [xx, xy, xz, yy, yz, zz] = self.products;
        let squares = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
        let mean_square = squares / self.count;
        let mut plane = flat(&(mean_square - mean * mean.transpose()))?;
        plane.thickness += UNCERTAIN * (LEAST_POINTS / self.count).powi(5) as f32;
        Some(plane)
    }
}

/// The plane of points with the covariance `spread`, in closed form; none where the points do not
/// lie on a plane.
fn flat(spread: &Matrix3<f64>) -> Option<PlaneFit> {
    let mean = spread.trace() / 3.0;
    let rest = spread - Matrix3::identity() * mean;
    let radius = (rest.norm_squared() / 6.0).sqrt();
    if radius.is_nan() || radius < NO_SPREAD {
        return None;
    }
    let half = (rest / radius).determinant() / 2.0;
    let angle = half.clamp(-1.0, 1.0).acos() / 3.0;
    let third = 2.0 * std::f64::consts::FRAC_PI_3;
    let most = mean + 2.0 * radius * angle.cos();
    let least = mean + 2.0 * radius * (angle + third).cos();
    let middle = 3.0 * mean - most - least;
    if middle - least < FLAT * most {
        return None;
    }
    // With the least eigenvalue subtracted, the columns are perpendicular to its eigenvector.
    let across = spread - Matrix3::identity() * least;
    let (a, b, c) = (across.column(0), across.column(1), across.column(2));
    let candidates = [a.cross(&b), b.cross(&c), c.cross(&a)];
    let longest = candidates
        .into_iter()
        .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    let normal = longest.try_normalize(0.0)?;
    Some(PlaneFit {
        normal: [normal.x as f32, normal.y as f32, normal.z as f32],
        thickness: (least / middle).max(0.0) as f32,
        variance: least.max(0.0) as f32,
    })
}

/// The constants that the kernel of a GPU has as well: its name of each, and the value here.
#[cfg(test)]
pub(crate) fn constants_of_planes() -> [(&'static str, f32); 3] {
    [
        ("LEAST_POINTS", LEAST_POINTS as f32),
        ("FLAT", FLAT as f32),
        ("NO_SPREAD", NO_SPREAD as f32),
    ]
}
