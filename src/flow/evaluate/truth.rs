//! Ground truth of a pair, and the selection of the scored rows.
//!
//! All metrics share one rule: a row is scored if the truth is valid, the point is not ground, the
//! estimate covers it and both flows are finite.

use crate::flow::data::{Point, RigidTransform};

/// Half-width of the close square, metres (Argoverse 2). A point is close if neither `abs(x)` nor
/// `abs(y)` exceeds it in the sensor's frame.
pub const CLOSE_HALF_WIDTH_M: f32 = 35.0;

/// The reason why a flow could not be scored.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum EvaluateError {
    /// An array does not have one row per point.
    #[error("{what} has {found} rows where {expected} are needed")]
    Length {
        /// Name of the array.
        what: &'static str,
        /// Rows of the true flow.
        expected: usize,
        /// Rows of the array.
        found: usize,
    },
    /// A metric needs data that the truth does not have.
    #[error("the truth has no {what}")]
    Missing {
        /// Name of the missing data.
        what: &'static str,
    },
    /// A class index is out of the accumulator's range.
    #[error("class {class} is not one of {classes} classes")]
    UnknownClass {
        /// The class index.
        class: u8,
        /// Number of classes.
        classes: usize,
    },
    /// No row can be scored: none is valid, off the ground, covered by the estimate and finite.
    #[error("no point can be scored")]
    NoPoints,
}

/// Ground truth of one pair. Every slice has N rows, one per source point.
#[derive(Debug, Clone, Copy)]
pub struct Truth<'a> {
    /// True flow, N x 3 metres per sweep interval, ego motion included.
    pub flow: &'a [Point],
    /// N flags: points whose true flow is known.
    pub valid: &'a [bool],
    /// N flags: points that move relative to the static world.
    pub dynamic: Option<&'a [bool]>,
    /// N flags: points on an object of a known class, parked or moving.
    pub foreground: Option<&'a [bool]>,
    /// N flags: ground points, which are never scored. Without it, no point counts as ground.
    pub ground: Option<&'a [bool]>,
    /// Source points, N x 3 metres, in the sensor's frame. They determine which points are close.
    pub source: Option<&'a [Point]>,
    /// Ego motion as target_from_source, translation in metres. It maps a static source point into
    /// the target's frame.
    pub ego: Option<&'a RigidTransform>,
}

impl<'a> Truth<'a> {
    /// Truth of a flow (N x 3, metres) and its valid mask (N flags) alone. Metrics that need more
    /// are then none, and [`super::BucketNormalized::add`] fails.
    pub fn new(flow: &'a [Point], valid: &'a [bool]) -> Self {
        Self {
            flow,
            valid,
            dynamic: None,
            foreground: None,
            ground: None,
            source: None,
            ego: None,
        }
    }

    /// Checks that every array, including those of the estimate, has one row per point of the true
    /// flow.
    pub(super) fn check_lengths(
        &self,
        flow: &[Point],
        covered: &[bool],
    ) -> Result<(), EvaluateError> {
        self.check_length("the flow", Some(flow.len()))?;
        self.check_length("the coverage mask", Some(covered.len()))?;
        self.check_length("the valid mask", Some(self.valid.len()))?;
        self.check_length("the dynamic mask", self.dynamic.map(<[bool]>::len))?;
        self.check_length("the foreground mask", self.foreground.map(<[bool]>::len))?;
        self.check_length("the ground mask", self.ground.map(<[bool]>::len))?;
        self.check_length("the source cloud", self.source.map(<[Point]>::len))
    }

    /// Checks that one array has one row per point of the true flow.
    pub(super) fn check_length(
        &self,
        what: &'static str,
        rows: Option<usize>,
    ) -> Result<(), EvaluateError> {
        let expected = self.flow.len();
        match rows {
            Some(found) if found != expected => Err(EvaluateError::Length {
                what,
                expected,
                found,
            }),
            _ => Ok(()),
        }
    }

    /// The scored rows, in order. The lengths must have been checked.
    pub(super) fn scored(&self, flow: &[Point], covered: &[bool]) -> impl Iterator<Item = usize> {
        (0..self.flow.len()).filter(move |&row| {
            self.valid[row]
                && covered[row]
                && !self.ground.is_some_and(|ground| ground[row])
                && is_finite(flow[row])
                && is_finite(self.flow[row])
        })
    }
}

/// Whether a source point lies in the close square around the sensor.
pub(super) fn is_close([x, y, _]: Point) -> bool {
    x.abs() <= CLOSE_HALF_WIDTH_M && y.abs() <= CLOSE_HALF_WIDTH_M
}

fn is_finite(vector: Point) -> bool {
    vector.iter().all(|component| component.is_finite())
}

/// The vector in double precision, which sums and angles use.
pub(super) fn double(vector: Point) -> [f64; 3] {
    vector.map(f64::from)
}

pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn norm(vector: [f64; 3]) -> f64 {
    dot(vector, vector).sqrt()
}

/// End-point error of one row, metres.
pub(super) fn end_point_error(estimate: [f64; 3], truth: [f64; 3]) -> f64 {
    norm([0, 1, 2].map(|axis| estimate[axis] - truth[axis]))
}

/// Running mean.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Mean {
    sum: f64,
    pub(super) count: usize,
}

impl Mean {
    pub(super) fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1;
    }

    pub(super) fn add_share(&mut self, holds: bool) {
        self.add(f64::from(u8::from(holds)));
    }

    /// The mean; none without values.
    pub(super) fn value(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_that_are_ground_invalid_uncovered_or_not_finite_are_not_scored() {
        let flow = [
            [0.0; 3],
            [0.0; 3],
            [0.0; 3],
            [f32::NAN, 0.0, 0.0],
            [0.0; 3],
            [0.0; 3],
        ];
        let true_flow = [
            [0.0; 3],
            [0.0; 3],
            [0.0; 3],
            [0.0; 3],
            [0.0, f32::INFINITY, 0.0],
            [0.0; 3],
        ];
        let valid = [false, true, true, true, true, true];
        let covered = [true, false, true, true, true, true];
        let ground = [false, false, true, false, false, false];
        let mut truth = Truth::new(&true_flow, &valid);
        truth.ground = Some(&ground);
        assert_eq!(truth.scored(&flow, &covered).collect::<Vec<_>>(), [5]);
    }

    #[test]
    fn an_array_of_another_length_is_named() {
        let flow = [[0.0; 3]; 2];
        let mut truth = Truth::new(&flow, &[true, true]);
        assert_eq!(truth.check_lengths(&flow, &[true; 2]), Ok(()));
        truth.foreground = Some(&[true]);
        let error = truth.check_lengths(&flow, &[true; 2]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the foreground mask has 1 rows where 2 are needed"
        );
        let error = truth.check_lengths(&flow[..1], &[true; 2]).unwrap_err();
        assert!(error.to_string().starts_with("the flow has 1"));
    }

    #[test]
    fn close_is_a_square_not_a_circle() {
        assert!(is_close([35.0, -35.0, 90.0]));
        assert!(!is_close([35.1, 0.0, 0.0]));
        assert!(!is_close([f32::NAN, 0.0, 0.0]));
    }
}
