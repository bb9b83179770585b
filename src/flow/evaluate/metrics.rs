//! The paper's metrics: EPE, Acc5, Acc10, outliers and angle error, and the EPE of subsets.
//!
//! The definitions are those of the official code, including its clamp and its constants. Sums are
//! in double precision; the official code uses single precision.

use super::three_way::{ThreeWay, ThreeWaySums};
use super::truth::{EvaluateError, Mean, Truth, dot, double, end_point_error, is_close, norm};
use crate::flow::data::Point;

/// Added to the length of the true flow in the relative error, metres, to keep it finite (official
/// code).
const LENGTH_FLOOR: f64 = 1e-20;
/// Cosines are clamped this far inside [-1, 1] (official code), so a perfect flow scores 4.5e-4
/// rad.
const COSINE_MARGIN: f64 = 1e-7;

/// Scene flow metrics of the FNSF paper (ICCV 2023), as its official evaluation code defines them,
/// over the scored points. A point is scored if its true flow is valid, it is not ground, the
/// estimate has a flow for it and both flows are finite. Definitions: `docs/method/evaluation.md`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Metrics {
    /// Number of scored points.
    pub points: usize,
    /// Mean end-point error (EPE), metres.
    pub epe: f64,
    /// Share of points, 0 to 1, with an end-point error under 0.05 m or under 5 % of the true flow.
    pub acc5: f64,
    /// Share of points, 0 to 1, with an end-point error under 0.1 m or under 10 % of the true flow.
    pub acc10: f64,
    /// Share of points, 0 to 1, with an end-point error over 0.3 m or over 10 % of the true flow.
    pub outliers: f64,
    /// Mean angle between estimated and true flow, radians; pi/2 for a point where either is zero.
    /// The official code clamps cosines, so a perfect flow scores 4.5e-4.
    pub angle_error: f64,
    /// EPE over dynamic points, metres; none without a dynamic mask or without such points.
    pub epe_dynamic: Option<f64>,
    /// EPE over static points, metres; none without a dynamic mask or without such points.
    pub epe_static: Option<f64>,
    /// Three-way EPE over the points in the close square, see [`super::CLOSE_HALF_WIDTH_M`]. None
    /// without the dynamic and foreground masks, the source cloud, or any close point.
    pub three_way: Option<ThreeWay>,
}

/// Scores the flow of one pair (N x 3, metres) against its truth. `covered` (N flags) marks the
/// rows for which the estimate has a flow.
///
/// # Errors
/// [`EvaluateError::Length`] if the arrays have different lengths. [`EvaluateError::NoPoints`] if
/// no row can be scored.
pub fn evaluate(flow: &[Point], covered: &[bool], truth: &Truth) -> Result<Metrics, EvaluateError> {
    let mut pool = Pool::default();
    pool.add(flow, covered, truth)?;
    pool.finish()
}

/// Accumulator of [`Metrics`] over many pairs. Every scored point has the same weight.
#[derive(Debug, Clone, Default)]
pub struct Pool {
    error: Mean,
    within_5: Mean,
    within_10: Mean,
    outlier: Mean,
    angle: Mean,
    dynamic_error: Mean,
    static_error: Mean,
    three_way: ThreeWaySums,
}

impl Pool {
    /// Adds the scored points of one pair. Arguments as in [`evaluate`]. A pair without a mask adds
    /// nothing to the metrics that need it.
    ///
    /// # Errors
    /// [`EvaluateError::Length`] if the arrays have different lengths; the pool is then unchanged.
    pub fn add(
        &mut self,
        flow: &[Point],
        covered: &[bool],
        truth: &Truth,
    ) -> Result<(), EvaluateError> {
        truth.check_lengths(flow, covered)?;
        for row in truth.scored(flow, covered) {
            let (estimated, expected) = (double(flow[row]), double(truth.flow[row]));
            let error = end_point_error(estimated, expected);
            self.add_errors(error, error / (norm(expected) + LENGTH_FLOOR));
            self.angle.add(angle_between(estimated, expected));

            let Some(dynamic) = truth.dynamic.map(|dynamic| dynamic[row]) else {
                continue;
            };
            if dynamic {
                self.dynamic_error.add(error);
            } else {
                self.static_error.add(error);
            }
            if let (Some(foreground), Some(source)) = (truth.foreground, truth.source)
                && is_close(source[row])
            {
                self.three_way.add(error, [foreground[row], dynamic]);
            }
        }
        Ok(())
    }

    fn add_errors(&mut self, error: f64, relative: f64) {
        self.error.add(error);
        self.within_5.add_share(error < 0.05 || relative < 0.05);
        self.within_10.add_share(error < 0.1 || relative < 0.1);
        self.outlier.add_share(error > 0.3 || relative > 0.1);
    }

    /// The metrics of all pairs added so far.
    ///
    /// # Errors
    /// [`EvaluateError::NoPoints`] if no row was scored.
    pub fn finish(&self) -> Result<Metrics, EvaluateError> {
        let mean = |mean: Mean| mean.value().ok_or(EvaluateError::NoPoints);
        Ok(Metrics {
            points: self.error.count,
            epe: mean(self.error)?,
            acc5: mean(self.within_5)?,
            acc10: mean(self.within_10)?,
            outliers: mean(self.outlier)?,
            angle_error: mean(self.angle)?,
            epe_dynamic: self.dynamic_error.value(),
            epe_static: self.static_error.value(),
            three_way: self.three_way.finish(),
        })
    }
}

/// Angle between two flows, radians. A zero flow has no direction and counts as a right angle.
fn angle_between(a: [f64; 3], b: [f64; 3]) -> f64 {
    let cosine = dot(unit(a), unit(b)).clamp(COSINE_MARGIN - 1.0, 1.0 - COSINE_MARGIN);
    if cosine.is_nan() { 0.0 } else { cosine }.acos()
}

/// Unit vector; NaN for the zero vector.
fn unit(vector: [f64; 3]) -> [f64; 3] {
    let length = norm(vector);
    vector.map(|component| component / length)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::FRAC_PI_2;

    /// Tolerance of single-precision input up to 10 m.
    const SINGLE: f64 = 1e-6;
    /// Tolerance of sums in another order.
    const ROUNDING: f64 = 1e-12;

    fn plain(flow: &[Point], truth: &[Point]) -> Metrics {
        let n = flow.len();
        let row = |i: usize| {
            let [a, b, c] = flow[i].map(f64::from);
            let [x, y, z] = truth[i].map(f64::from);
            let error = ((a - x).powi(2) + (b - y).powi(2) + (c - z).powi(2)).sqrt();
            let length = (x * x + y * y + z * z).sqrt();
            let product = (a * a + b * b + c * c).sqrt() * length;
            let cosine = (a * x + b * y + c * z) / product;
            let angle = if product == 0.0 {
                FRAC_PI_2
            } else {
                cosine.clamp(-0.999_999_9, 0.999_999_9).acos()
            };
            (error, error / (length + 1e-20), angle)
        };
        let rows: Vec<(f64, f64, f64)> = (0..n).map(row).collect();
        let share = |holds: &dyn Fn(&(f64, f64, f64)) -> bool| {
            rows.iter().filter(|row| holds(row)).count() as f64 / n as f64
        };
        Metrics {
            points: n,
            epe: rows.iter().map(|row| row.0).sum::<f64>() / n as f64,
            acc5: share(&|row| row.0.min(row.1) < 0.05),
            acc10: share(&|row| row.0.min(row.1) < 0.1),
            outliers: share(&|row| row.0 > 0.3 || row.1 > 0.1),
            angle_error: rows.iter().map(|row| row.2).sum::<f64>() / n as f64,
            epe_dynamic: None,
            epe_static: None,
            three_way: None,
        }
    }

    fn assert_same(a: &Metrics, b: &Metrics, tolerance: f64) {
        assert_eq!(a.points, b.points);
        let values = |m: &Metrics| [m.epe, m.acc5, m.acc10, m.outliers, m.angle_error];
        for (a, b) in values(a).into_iter().zip(values(b)) {
            assert!((a - b).abs() <= tolerance, "{a} {b}");
        }
    }

    #[test]
    fn a_case_done_by_hand() {
        let truth = [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0; 3], [10.0, 0.0, 0.0]];
        let flow = [
            [1.0, 0.04, 0.0],
            [2.0, 0.0, 0.0],
            [0.0, 0.0, 0.2],
            [10.4, 0.0, 0.0],
        ];
        let dynamic = [false, true, false, true];
        let mut labelled = Truth::new(&truth, &[true; 4]);
        labelled.dynamic = Some(&dynamic);
        let metrics = evaluate(&flow, &[true; 4], &labelled).unwrap();
        let far = 8f64.sqrt();
        assert_eq!(metrics.points, 4);
        assert!((metrics.epe - (0.04 + far + 0.2 + 0.4) / 4.0).abs() < SINGLE);
        // Row 0 is within 5 cm, row 3 within 5 %.
        assert_eq!((metrics.acc5, metrics.acc10), (0.5, 0.5));
        // Row 1 by its absolute error, row 2 by its infinite relative error, row 3 by its absolute
        // error.
        assert_eq!(metrics.outliers, 0.75);
        let parallel = (1.0f64 - 1e-7).acos();
        let angle = (0.04f64.atan() + FRAC_PI_2 + FRAC_PI_2 + parallel) / 4.0;
        assert!((metrics.angle_error - angle).abs() < SINGLE);
        assert!((metrics.epe_dynamic.unwrap() - (far + 0.4) / 2.0).abs() < SINGLE);
        assert!((metrics.epe_static.unwrap() - 0.12).abs() < SINGLE);
        assert_eq!(metrics.three_way, None);
    }

    #[test]
    fn three_way_counts_close_points_only() {
        let source = [
            [0.0; 3],
            [34.0, 0.0, 0.0],
            [0.0, -34.0, 0.0],
            [0.0, 36.0, 0.0],
        ];
        let true_flow = [[0.0; 3]; 4];
        let flow = [
            [0.3, 0.0, 0.0],
            [0.6, 0.0, 0.0],
            [0.9, 0.0, 0.0],
            [9.0, 0.0, 0.0],
        ];
        let (dynamic, foreground) = ([true, false, false, false], [true, true, false, false]);
        let truth = Truth {
            dynamic: Some(&dynamic),
            foreground: Some(&foreground),
            source: Some(&source),
            ..Truth::new(&true_flow, &[true; 4])
        };
        let three_way = evaluate(&flow, &[true; 4], &truth)
            .unwrap()
            .three_way
            .unwrap();
        assert!((three_way.epe.unwrap() - 0.6).abs() < SINGLE);
        assert_eq!(three_way.background_static.points, 1);
    }

    #[test]
    fn nothing_to_score_is_an_error() {
        let truth = Truth::new(&[[0.0; 3]], &[false]);
        assert_eq!(
            evaluate(&[[0.0; 3]], &[true], &truth),
            Err(EvaluateError::NoPoints)
        );
        assert!(evaluate(&[], &[], &truth).is_err());
    }

    fn vector() -> impl Strategy<Value = Point> {
        let component = prop_oneof![Just(0.0f32), -0.2f32..0.2, -4.0f32..4.0];
        [component.clone(), component.clone(), component]
    }

    fn rows() -> impl Strategy<Value = Vec<(Point, Point, bool)>> {
        prop::collection::vec((vector(), vector(), any::<bool>()), 1..60)
    }

    fn score(rows: &[(Point, Point, bool)]) -> Metrics {
        let flow: Vec<Point> = rows.iter().map(|row| row.0).collect();
        let true_flow: Vec<Point> = rows.iter().map(|row| row.1).collect();
        let dynamic: Vec<bool> = rows.iter().map(|row| row.2).collect();
        let all = vec![true; rows.len()];
        let mut truth = Truth::new(&true_flow, &all);
        truth.dynamic = Some(&dynamic);
        evaluate(&flow, &all, &truth).unwrap()
    }

    proptest! {
        #[test]
        fn the_plain_formulation_agrees(rows in rows()) {
            let flow: Vec<Point> = rows.iter().map(|row| row.0).collect();
            let true_flow: Vec<Point> = rows.iter().map(|row| row.1).collect();
            // The arc cosine near its clamp magnifies rounding by about 2,000.
            assert_same(&score(&rows), &plain(&flow, &true_flow), 1e-9);
        }

        #[test]
        fn a_perfect_flow_has_no_error(rows in rows()) {
            let perfect: Vec<_> = rows.iter().map(|row| (row.1, row.1, row.2)).collect();
            let metrics = score(&perfect);
            prop_assert_eq!((metrics.epe, metrics.outliers), (0.0, 0.0));
            prop_assert_eq!((metrics.acc5, metrics.acc10), (1.0, 1.0));
        }

        #[test]
        fn the_order_of_rows_does_not_matter(
            (rows, shuffled) in rows().prop_flat_map(|rows| (Just(rows.clone()), Just(rows).prop_shuffle()))
        ) {
            assert_same(&score(&rows), &score(&shuffled), ROUNDING);
        }

        #[test]
        fn a_pool_of_parts_equals_the_whole(rows in rows(), at in 0usize..60) {
            let (left, right) = rows.split_at(at.min(rows.len()));
            let mut pool = Pool::default();
            for part in [left, right] {
                let flow: Vec<Point> = part.iter().map(|row| row.0).collect();
                let true_flow: Vec<Point> = part.iter().map(|row| row.1).collect();
                let all = vec![true; part.len()];
                pool.add(&flow, &all, &Truth::new(&true_flow, &all)).unwrap();
            }
            assert_same(&pool.finish().unwrap(), &score(&rows), ROUNDING);
        }

        #[test]
        fn dynamic_and_static_errors_average_to_the_whole(rows in rows()) {
            let metrics = score(&rows);
            let dynamic = rows.iter().filter(|row| row.2).count() as f64;
            let total = metrics.epe_dynamic.unwrap_or(0.0) * dynamic
                + metrics.epe_static.unwrap_or(0.0) * (rows.len() as f64 - dynamic);
            prop_assert!((total / rows.len() as f64 - metrics.epe).abs() < ROUNDING);
        }
    }
}
