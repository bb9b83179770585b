//! A neighbor sweep, transformed into the target's frame.

use super::point::Point;

/// A neighbor sweep, transformed into the target's frame, for an object search.
#[derive(Clone, Debug)]
pub struct AlignedSweep {
    /// K points, metres, in the target's frame: those that are finite, within the crop and not
    /// excluded as ground.
    pub points: Vec<Point>,
    /// Time of the sweep after the source, in sweep intervals; negative for a sweep before the
    /// source.
    pub at: i8,
}
