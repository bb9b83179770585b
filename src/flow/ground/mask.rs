//! Ground mask of a sweep with the default options.

use super::options::GroundOptions;
use super::segment::segment;
use crate::flow::data::Point;

/// Ground mask of N points with the default options: N flags. All points must be finite and in
/// range.
pub(crate) fn mask(points: &[Point]) -> Vec<bool> {
    segment(points, &GroundOptions::default()).ground
}
