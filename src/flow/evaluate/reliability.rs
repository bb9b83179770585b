//! Calibration of the two probabilities of a point: reliability diagram and expected calibration error.
//!
//! The confidence is right if the end-point error is below [`CONFIDENT_WITHIN_M`], the probability of
//! motion if the point moves. The expected calibration error is the mean absolute difference
//! between the probability and the share of points where it is right, over ten bins of the probability,
//! weighted by points (Guo et al. 2017).

use super::truth::{EvaluateError, Truth, double, end_point_error};
use crate::flow::data::Point;
use crate::flow::objects::CONFIDENT_WITHIN_M;

/// Bins of the reliability diagram.
const BINS: usize = 10;
/// Histogram cells of the probability, in which errors are summed. Points in one cell are not
/// distinguished.
const CELLS: usize = 1000 * BINS;

/// Accumulator of probabilities and end-point errors over many pairs, in constant memory.
///
/// Probabilities are counted in 10,000 cells of equal width. Points in the same cell are not
/// distinguished: each counts with the mean error of its cell.
#[derive(Clone, Debug)]
pub struct Reliability {
    cells: Vec<Cell>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    probability: f64,
    error_m: f64,
    right: f64,
    points: f64,
}

/// Calibration of a probability.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Number of points.
    pub points: usize,
    /// Expected calibration error, 0 to 1: the mean absolute difference between the probability and the
    /// share of points where it is right over the bins, weighted by points (Guo et al. 2017).
    pub error: f64,
    /// Share, 0 to 1, of the points where the probability is right that have a probability of 0.5 or more. None
    /// if it is right nowhere.
    pub recall: Option<f64>,
    /// Share, 0 to 1, of the points with a probability of 0.5 or more where it is right. None if there
    /// are none.
    pub precision: Option<f64>,
    /// EPE of the half of the points with the higher probability, metres. A cell across the boundary
    /// between the halves counts partly in each, with its mean error.
    pub sure_half_epe: f64,
    /// EPE of the other half, metres.
    pub rest_epe: f64,
    /// The bins of the reliability diagram that have points, lowest confidence first. There are ten
    /// bins, each 0.1 wide.
    pub bins: Vec<CalibrationBin>,
}

/// One bin of a reliability diagram.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationBin {
    /// Share of all points that are in the bin, 0 to 1.
    pub share: f64,
    /// Mean probability of its points, 0 to 1.
    pub probability: f64,
    /// Share of its points where the probability is right, 0 to 1.
    pub right: f64,
}

impl Default for Reliability {
    fn default() -> Self {
        Self {
            cells: vec![Cell::default(); CELLS],
        }
    }
}

impl Reliability {
    /// Adds a point with a probability of 0 to 1, whether that is `right`, and an end-point error of
    /// `error_m` metres. A lower probability counts in the first bin, a higher one in the last. The
    /// values must not be NaN, because the results that use them would be NaN.
    pub fn add(&mut self, probability: f64, right: bool, error_m: f64) {
        let cell = ((probability * CELLS as f64) as usize).min(CELLS - 1);
        let cell = &mut self.cells[cell];
        cell.probability += probability;
        cell.error_m += error_m;
        cell.right += f64::from(u8::from(right));
        cell.points += 1.0;
    }

    /// Adds the scored points of one pair, with its flow (N x 3, metres) and N confidences, 0 to 1.
    /// `covered` (N flags) marks the rows for which the estimate has a flow. Points are scored
    /// under the same conditions as for [`super::Metrics`]. Confidences out of range are treated as
    /// in [`Self::add`].
    ///
    /// # Errors
    /// [`EvaluateError::Length`] if the arrays have different lengths; nothing is added then.
    pub fn add_confidence(
        &mut self,
        flow: &[Point],
        covered: &[bool],
        confidence: &[f32],
        truth: &Truth,
    ) -> Result<(), EvaluateError> {
        let right = |_row: usize, error_m: f64| error_m < f64::from(CONFIDENT_WITHIN_M);
        self.add_pair(flow, covered, confidence, truth, right)
    }

    /// As [`Self::add_confidence`], for N probabilities that the points move.
    ///
    /// # Errors
    /// Also [`EvaluateError::Missing`] if the truth does not say which points move.
    pub fn add_moving(
        &mut self,
        flow: &[Point],
        covered: &[bool],
        moving: &[f32],
        truth: &Truth,
    ) -> Result<(), EvaluateError> {
        let missing = EvaluateError::Missing {
            what: "dynamic mask",
        };
        let dynamic = truth.dynamic.ok_or(missing)?;
        let right = |row: usize, _error_m: f64| dynamic[row];
        self.add_pair(flow, covered, moving, truth, right)
    }

    fn add_pair(
        &mut self,
        flow: &[Point],
        covered: &[bool],
        probabilities: &[f32],
        truth: &Truth,
        right: impl Fn(usize, f64) -> bool,
    ) -> Result<(), EvaluateError> {
        truth.check_lengths(flow, covered)?;
        truth.check_length("the probability", Some(probabilities.len()))?;
        for row in truth.scored(flow, covered) {
            let error_m = end_point_error(double(flow[row]), double(truth.flow[row]));
            self.add(f64::from(probabilities[row]), right(row, error_m), error_m);
        }
        Ok(())
    }

    /// The calibration over all points added so far; none without points.
    pub fn finish(&self) -> Option<Calibration> {
        let sum = |cells: &[Cell]| {
            cells.iter().fold(Cell::default(), |sum, cell| Cell {
                probability: sum.probability + cell.probability,
                error_m: sum.error_m + cell.error_m,
                right: sum.right + cell.right,
                points: sum.points + cell.points,
            })
        };
        let all = sum(&self.cells);
        if all.points == 0.0 {
            return None;
        }
        let bins = self.cells.chunks(CELLS / BINS).map(sum);
        let bins: Vec<CalibrationBin> = bins
            .filter(|bin| bin.points > 0.0)
            .map(|bin| CalibrationBin {
                share: bin.points / all.points,
                probability: bin.probability / bin.points,
                right: bin.right / bin.points,
            })
            .collect();
        let off = bins
            .iter()
            .map(|bin| bin.share * (bin.probability - bin.right).abs());
        let upper = sum(&self.cells[CELLS / 2..]);
        // The cell that contains the median counts partly in each half.
        let (mut left, mut sure_m) = (all.points / 2.0, 0.0);
        for cell in self.cells.iter().rev().filter(|cell| cell.points > 0.0) {
            let taken = cell.points.min(left);
            sure_m += cell.error_m * taken / cell.points;
            left -= taken;
        }
        Some(Calibration {
            points: all.points as usize,
            error: off.sum(),
            recall: (all.right > 0.0).then(|| upper.right / all.right),
            precision: (upper.points > 0.0).then(|| upper.right / upper.points),
            sure_half_epe: sure_m / (all.points / 2.0),
            rest_epe: (all.error_m - sure_m) / (all.points / 2.0),
            bins,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROUNDING: f64 = 1e-12;

    #[test]
    fn nothing_has_no_calibration() {
        assert_eq!(Reliability::default().finish(), None);
    }

    #[test]
    fn a_case_done_by_hand() {
        let mut reliability = Reliability::default();
        // Of four points at 0.9 three are correct, of two at 0.25 none is.
        for (confidence, error_m) in [
            (0.9, 0.01),
            (0.9, 0.02),
            (0.9, 0.03),
            (0.9, 0.3),
            (0.25, 0.5),
            (0.25, 0.1),
        ] {
            reliability.add(confidence, error_m < 0.05, error_m);
        }
        let found = reliability.finish().expect("points");
        assert_eq!(found.points, 6);
        let expected = 4.0 / 6.0 * 0.15 + 2.0 / 6.0 * 0.25;
        assert!((found.error - expected).abs() < ROUNDING, "{found:?}");
        assert_eq!((found.recall, found.precision), (Some(1.0), Some(0.75)));
        // Three of the four points in the upper cell, each with the mean error of the cell.
        assert!((found.sure_half_epe - 0.09).abs() < ROUNDING, "{found:?}");
        let rest = (0.09 + 0.6) / 3.0;
        assert!((found.rest_epe - rest).abs() < ROUNDING, "{found:?}");
        let bins: Vec<f64> = found.bins.iter().map(|bin| bin.right).collect();
        assert_eq!(bins, [0.0, 0.75]);
    }

    #[test]
    fn the_ends_of_the_scale_have_bins_too() {
        let mut reliability = Reliability::default();
        reliability.add(0.0, false, 1.0);
        reliability.add(1.0, true, 0.0);
        let found = reliability.finish().expect("points");
        assert_eq!((found.error, found.bins.len()), (0.0, 2));
        assert_eq!((found.sure_half_epe, found.rest_epe), (0.0, 1.0));
    }

    #[test]
    fn only_scored_rows_count_and_lengths_must_agree() {
        let truth = [[0.0; 3]; 2];
        let truth = Truth::new(&truth, &[true, false]);
        let mut reliability = Reliability::default();
        let flow = [[0.0; 3]; 2];
        let added = reliability.add_confidence(&flow, &[true; 2], &[0.5; 2], &truth);
        assert_eq!(added, Ok(()));
        assert_eq!(reliability.finish().map(|found| found.points), Some(1));
        assert!(
            reliability
                .add_confidence(&flow, &[true; 2], &[0.5], &truth)
                .is_err()
        );
        assert!(
            reliability
                .add_moving(&flow, &[true; 2], &[0.5; 2], &truth)
                .is_err()
        );
        let truth = Truth {
            dynamic: Some(&[true, true]),
            ..truth
        };
        let mut moving = Reliability::default();
        let added = moving.add_moving(&flow, &[true; 2], &[0.75; 2], &truth);
        assert_eq!(added, Ok(()));
        let found = moving.finish().map(|found| (found.points, found.recall));
        assert_eq!(found, Some((1, Some(1.0))));
    }
}
