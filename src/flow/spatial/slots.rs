//! The points of a column index in the order of its columns, one array an axis.

use super::tiles::Tiles;
use crate::flow::data::Point;

/// Floats in the largest vector register, and the number of floats after the last slot that may be
/// read.
pub(super) const MOST_LANES: usize = 16;

/// The points in the order of the columns.
#[derive(Debug)]
pub(super) struct Slots {
    pub(super) tiles: Tiles,
    /// Coordinates of each slot, and padding that is infinitely far.
    pub(super) axes: [Vec<f32>; 3],
}

impl Slots {
    /// Sorts `points` into columns with a side of `column_m` metres. Also returns the input row of
    /// each slot.
    pub(super) fn new(points: &[Point], column_m: f32) -> (Self, Vec<u32>) {
        let (tiles, rows) = Tiles::new(points, column_m);
        let axes = [0, 1, 2].map(|axis: usize| {
            let values = rows.iter().map(|&row| points[row as usize][axis]);
            padded(values, points.len(), f32::INFINITY)
        });
        (Self { tiles, axes }, rows)
    }

    /// Number of slots with the padding.
    pub(super) fn padded(&self) -> usize {
        self.axes[0].len()
    }
}

/// One value for each of `count` slots, and padding.
pub(super) fn padded(values: impl Iterator<Item = f32>, count: usize, padding: f32) -> Vec<f32> {
    let mut padded = Vec::with_capacity(count + MOST_LANES);
    padded.extend(values);
    padded.resize(count + MOST_LANES, padding);
    padded
}
