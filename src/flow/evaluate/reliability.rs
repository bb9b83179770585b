//! Calibration of the confidence: reliability diagram and expected calibration error.
//!
//! A point is correct if its end-point error is below [`CONFIDENT_WITHIN_M`]. The expected
//! calibration error is the mean absolute difference between confidence and share of correct points
//! over ten confidence bins, weighted by points (Guo et al. 2017).

use super::truth::{EvaluateError, Truth, double, end_point_error};
use crate::flow::data::Point;
use crate::flow::objects::CONFIDENT_WITHIN_M;

/// Bins of the reliability diagram.
const BINS: usize = 10;
/// Histogram cells of the confidence, in which errors are summed. Points in one cell are not
/// distinguished.
const CELLS: usize = 1000 * BINS;

/// Accumulator of confidences and end-point errors over many pairs, in constant memory.
///
/// Confidences are counted in 10,000 cells of equal width. Points in the same cell are not
/// distinguished: each counts with the mean error of its cell.
#[derive(Clone, Debug)]
pub struct Reliability {
    cells: Vec<Cell>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    confidence: f64,
    error_m: f64,
    right: f64,
    points: f64,
}

/// Calibration of a confidence. A point is correct if its end-point error is below
/// [`CONFIDENT_WITHIN_M`].
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Number of points.
    pub points: usize,
    /// Expected calibration error, 0 to 1: the mean absolute difference between the confidence and
    /// the share of correct points over the bins, weighted by points (Guo et al. 2017).
    pub error: f64,
    /// EPE of the half of the points with the higher confidence, metres. A cell across the boundary
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
    /// Mean confidence of its points, 0 to 1.
    pub confidence: f64,
    /// Share of its points that are correct, 0 to 1.
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
    /// Adds a point with a confidence of 0 to 1 and an end-point error of `error_m` metres. A lower
    /// confidence counts in the first bin, a higher one in the last. The values must not be NaN,
    /// because the results that use them would be NaN.
    pub fn add(&mut self, confidence: f64, error_m: f64) {
        let cell = ((confidence * CELLS as f64) as usize).min(CELLS - 1);
        let cell = &mut self.cells[cell];
        cell.confidence += confidence;
        cell.error_m += error_m;
        cell.right += f64::from(u8::from(error_m < f64::from(CONFIDENT_WITHIN_M)));
        cell.points += 1.0;
    }

    /// Adds the scored points of one pair, with its flow (N x 3, metres) and N confidences, 0 to 1.
    /// `covered` (N flags) marks the rows for which the estimate has a flow. Points are scored
    /// under the same conditions as for [`super::Metrics`]. Confidences out of range are treated as
    /// in [`Self::add`].
    ///
    /// # Errors
    /// [`EvaluateError::Length`] if the arrays have different lengths; nothing is added then.
    pub fn add_pair(
        &mut self,
        flow: &[Point],
        covered: &[bool],
        confidence: &[f32],
        truth: &Truth,
    ) -> Result<(), EvaluateError> {
        truth.check_lengths(flow, covered)?;
        truth.check_length("the confidence", Some(confidence.len()))?;
        for row in truth.scored(flow, covered) {
            let error_m = end_point_error(double(flow[row]), double(truth.flow[row]));
            self.add(f64::from(confidence[row]), error_m);
        }
        Ok(())
    }

    /// The calibration over all points added so far; none without points.
    pub fn finish(&self) -> Option<Calibration> {
        let sum = |cells: &[Cell]| {
            cells.iter().fold(Cell::default(), |sum, cell| Cell {
                confidence: sum.confidence + cell.confidence,
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
                confidence: bin.confidence / bin.points,
                right: bin.right / bin.points,
            })
            .collect();
        let off = bins
            .iter()
            .map(|bin| bin.share * (bin.confidence - bin.right).abs());
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
            reliability.add(confidence, error_m);
        }
        let found = reliability.finish().expect("points");
        assert_eq!(found.points, 6);
        let expected = 4.0 / 6.0 * 0.15 + 2.0 / 6.0 * 0.25;
        assert!((found.error - expected).abs() < ROUNDING, "{found:?}");
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
        reliability.add(0.0, 1.0);
        reliability.add(1.0, 0.0);
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
        let added = reliability.add_pair(&flow, &[true; 2], &[0.5; 2], &truth);
        assert_eq!(added, Ok(()));
        assert_eq!(reliability.finish().map(|found| found.points), Some(1));
        assert!(
            reliability
                .add_pair(&flow, &[true; 2], &[0.5], &truth)
                .is_err()
        );
    }
}
