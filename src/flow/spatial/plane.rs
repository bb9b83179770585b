//! The plane through a few points, where they lie nearly on one.
//!
//! It must not know which points are neighbors, or what a plane is for.

use nalgebra::{Matrix3, Vector3};

use crate::flow::data::Point;

/// Fewer points than this, the one in the middle among them, make no surface.
const NEIGHBORS: f64 = 4.0;
/// A surface is flat where its spread along its second axis exceeds that along its normal by this
/// share of the spread along its first. Less flat ones are branches and wires; with more asked for,
/// walls seen by one ring are lost.
const FLAT: f64 = 0.05;
/// Spreads below this are none, square metres.
const NO_SPREAD: f64 = 1e-12;

/// A plane that points lie on.
#[derive(Clone, Copy)]
pub(crate) struct PlaneFit {
    /// Unit length, on either side.
    pub(crate) normal: [f32; 3],
    /// The points' spread along the normal over that along their second axis, as variances: 0 for
    /// a plane.
    pub(crate) thickness: f32,
}

/// How the points around one lie about it.
pub(crate) struct Neighborhood {
    middle: Point,
    count: f64,
    sum: Vector3<f64>,
    squares: Matrix3<f64>,
}

impl Neighborhood {
    /// Of nothing yet.
    pub(crate) fn of(middle: Point) -> Self {
        Self {
            middle,
            count: 0.0,
            sum: Vector3::zeros(),
            squares: Matrix3::zeros(),
        }
    }

    /// Takes a point in.
    #[inline]
    pub(crate) fn add(&mut self, point: Point) {
        let away = Vector3::from_fn(|a, _| f64::from(point[a] - self.middle[a]));
        self.count += 1.0;
        self.sum += away;
        self.squares += away * away.transpose();
    }

    /// The plane of the points; none where there are few or they do not lie on one.
    pub(crate) fn flat(&self) -> Option<PlaneFit> {
        if self.count < NEIGHBORS {
            return None;
        }
        let mean = self.sum / self.count;
        flat(&(self.squares / self.count - mean * mean.transpose()))
    }
}

/// The plane of points by their covariance, in closed form; none where they do not lie on one.
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
    // The rows of what is left without the least spread are at right angles to its axis.
    let across = spread - Matrix3::identity() * least;
    let [a, b, c] = [0, 1, 2].map(|i| across.column(i).into_owned());
    let candidates = [a.cross(&b), b.cross(&c), c.cross(&a)];
    let longest = candidates
        .into_iter()
        .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    let normal = longest.try_normalize(0.0)?;
    Some(PlaneFit {
        normal: [normal.x as f32, normal.y as f32, normal.z as f32],
        thickness: (least / middle).max(0.0) as f32,
    })
}
