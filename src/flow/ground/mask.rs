//! TODO doc

use super::options::GroundOptions;
use super::segment::segment;
use crate::flow::data::Point;

/// Which of the points are ground, by the usual options; all of them are finite and in range.
pub(crate) fn mask(points: &[Point]) -> Vec<bool> {
    segment(points, &GroundOptions::default()).ground
}
