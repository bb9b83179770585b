//! A neighbor sweep, transformed into the target's frame.

use super::point::Point;

/// The points of a neighbor sweep that an estimate uses, in the target's frame.
#[derive(Clone, Debug)]
pub struct AlignedSweep {
    /// K points that are not ground, metres, in the target's frame.
    pub points: Vec<Point>,
    /// Time of the sweep after the source, in sweep intervals; negative for a sweep before the
    /// source.
    pub at: i8,
}
