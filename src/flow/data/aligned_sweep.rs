//! A neighbor sweep, transformed into the target's frame.

use super::point::Point;

/// The points of a neighbor sweep that an estimate uses, in the target's frame.
#[derive(Clone, Debug)]
pub struct AlignedSweep {
    /// Points that are not ground, metres.
    pub points: Vec<Point>,
    /// Its time after the source, in sweep intervals; negative for a sweep before the source.
    pub at: i8,
}
