//! Argoverse 2 scene flow metrics: accuracy, angle error, dynamic IoU, three-way EPE.
//!
//! They cover all ranges and differ from the paper's metrics: the angle is in space-time, the
//! relative error has another floor, and the three-way EPE pools all scored points, close or far.
//! The official task scores a square of 50 m half-width around the sensor. Include that square in
//! the valid mask.

use super::three_way::{ThreeWay, ThreeWaySums};
use super::truth::{EvaluateError, Mean, Truth, double, end_point_error, norm};
use crate::flow::data::Point;

/// Time between sweeps, seconds: the fourth component of every flow vector.
const SWEEP_SECONDS: f64 = 0.1;
/// Added to the length of the true flow in the relative error, metres, to keep it finite.
const LENGTH_FLOOR: f64 = 1e-10;

/// Metrics of the Argoverse 2 scene flow task, over the scored points at all ranges.
///
/// A point is scored under the same conditions as for [`super::Metrics`]. The official task scores
/// a square of 50 m half-width around the sensor: put that square into [`Truth::valid`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Argoverse2 {
    /// Number of scored points.
    pub points: usize,
    /// Share of points, 0 to 1, with an end-point error under 0.05 m or under 5 % of the true flow.
    pub accuracy_strict: f64,
    /// Share of points, 0 to 1, with an end-point error under 0.1 m or under 10 % of the true flow.
    pub accuracy_relax: f64,
    /// Mean angle between estimated and true flow with 0.1 s appended to each as a fourth
    /// component, radians.
    pub angle_error: f64,
    /// Intersection over union of the predicted and the true dynamic mask: true positives over the
    /// sum of true positives, false positives and false negatives. None without a predicted mask,
    /// without a true mask, or if no scored point is dynamic in either.
    pub dynamic_iou: Option<f64>,
    /// Three-way EPE over all scored points, close or far; none without the dynamic and foreground
    /// masks.
    pub three_way: Option<ThreeWay>,
}

/// Scores the flow of one pair (N x 3, metres) and its predicted dynamic mask (N flags), if given.
/// `covered` (N flags) marks the rows for which the estimate has a flow.
///
/// # Errors
/// [`EvaluateError::Length`] if the arrays have different lengths. [`EvaluateError::NoPoints`] if
/// no row can be scored.
pub fn evaluate_argoverse2(
    flow: &[Point],
    covered: &[bool],
    predicted_dynamic: Option<&[bool]>,
    truth: &Truth,
) -> Result<Argoverse2, EvaluateError> {
    let mut pool = Argoverse2Pool::default();
    pool.add(flow, covered, predicted_dynamic, truth)?;
    pool.finish()
}

/// Accumulator of [`Argoverse2`] metrics over many pairs. Every scored point has the same weight.
#[derive(Debug, Clone, Default)]
pub struct Argoverse2Pool {
    strict: Mean,
    relax: Mean,
    angle: Mean,
    /// Over points that are dynamic in the estimate or in the truth: whether they are dynamic in
    /// both.
    overlap: Mean,
    three_way: ThreeWaySums,
}

impl Argoverse2Pool {
    /// Adds the scored points of one pair. Arguments as in [`evaluate_argoverse2`]. A pair without
    /// a mask adds nothing to the metrics that need it.
    ///
    /// # Errors
    /// [`EvaluateError::Length`] if the arrays have different lengths; the pool is then unchanged.
    pub fn add(
        &mut self,
        flow: &[Point],
        covered: &[bool],
        predicted_dynamic: Option<&[bool]>,
        truth: &Truth,
    ) -> Result<(), EvaluateError> {
        truth.check_lengths(flow, covered)?;
        let predicted_rows = predicted_dynamic.map(<[bool]>::len);
        truth.check_length("the predicted dynamic mask", predicted_rows)?;
        for row in truth.scored(flow, covered) {
            let (estimated, expected) = (double(flow[row]), double(truth.flow[row]));
            let error = end_point_error(estimated, expected);
            let relative = error / (norm(expected) + LENGTH_FLOOR);
            self.strict.add_share(error < 0.05 || relative < 0.05);
            self.relax.add_share(error < 0.1 || relative < 0.1);
            self.angle.add(space_time_angle(estimated, expected));

            let Some(dynamic) = truth.dynamic.map(|dynamic| dynamic[row]) else {
                continue;
            };
            if let Some(predicted) = predicted_dynamic.map(|predicted| predicted[row])
                && (predicted || dynamic)
            {
                self.overlap.add_share(predicted && dynamic);
            }
            if let Some(foreground) = truth.foreground {
                self.three_way.add(error, [foreground[row], dynamic]);
            }
        }
        Ok(())
    }

    /// The metrics of all pairs added so far.
    ///
    /// # Errors
    /// [`EvaluateError::NoPoints`] if no row was scored.
    pub fn finish(&self) -> Result<Argoverse2, EvaluateError> {
        let mean = |mean: Mean| mean.value().ok_or(EvaluateError::NoPoints);
        Ok(Argoverse2 {
            points: self.strict.count,
            accuracy_strict: mean(self.strict)?,
            accuracy_relax: mean(self.relax)?,
            angle_error: mean(self.angle)?,
            dynamic_iou: self.overlap.value(),
            three_way: self.three_way.finish(),
        })
    }
}

/// Angle between (flow, 0.1 s) of both flows, radians. Always defined, because the fourth component
/// is not zero.
fn space_time_angle(a: [f64; 3], b: [f64; 3]) -> f64 {
    let square = SWEEP_SECONDS * SWEEP_SECONDS;
    let dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + square;
    let length = |v: [f64; 3]| (norm(v) * norm(v) + square).sqrt();
    (dot / (length(a) * length(b))).clamp(-1.0, 1.0).acos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_4;

    #[test]
    fn a_case_done_by_hand() {
        let flow = [[0.1, 0.0, 0.0], [0.0; 3], [0.0; 3], [0.0; 3]];
        let true_flow = [[0.0; 3]; 4];
        let (dynamic, foreground) = ([true, true, false, false], [true, false, true, false]);
        let truth = Truth {
            dynamic: Some(&dynamic),
            foreground: Some(&foreground),
            ..Truth::new(&true_flow, &[true; 4])
        };
        let predicted = [true, false, true, false];
        let score = evaluate_argoverse2(&flow, &[true; 4], Some(&predicted), &truth).unwrap();
        assert_eq!(score.points, 4);
        assert_eq!(score.accuracy_strict, 0.75);
        // 0.1 in single precision is slightly more than a tenth.
        assert_eq!(score.accuracy_relax, 0.75);
        assert!((score.angle_error - FRAC_PI_4 / 4.0).abs() < 1e-7);
        assert_eq!(score.dynamic_iou, Some(1.0 / 3.0));
        let three_way = score.three_way.unwrap();
        assert!((three_way.epe.unwrap() - 0.1 / 3.0).abs() < 1e-8);
    }

    #[test]
    fn without_masks_the_parts_that_need_them_are_left_out() {
        let true_flow = [[1.0, 0.0, 0.0]];
        let truth = Truth::new(&true_flow, &[true]);
        let score = evaluate_argoverse2(&true_flow, &[true], Some(&[true]), &truth).unwrap();
        assert_eq!((score.dynamic_iou, score.three_way), (None, None));
        assert!(score.angle_error < 1e-7);
        let error = evaluate_argoverse2(&true_flow, &[true], Some(&[]), &truth).unwrap_err();
        assert!(error.to_string().contains("predicted"));
    }
}
