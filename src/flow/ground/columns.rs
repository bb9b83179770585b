//! A sweep as upright columns of one square metre, and the lowest layer of each.
//!
//! A column of ground is flat: nearly all of its points lie in one thin layer. A wall's or a
//! bush's points go on above it. It must not know of surfaces.

use std::ops::Range;

use crate::flow::data::Point;

/// Side of a column, metres.
const SIDE_M: f32 = 1.0;
/// Half extents of the area looked at are whole multiples of this, metres.
pub(super) const TILE_M: f32 = 32.0;
/// Nothing farther than this along x or y is looked at, metres: rings there are tens of metres
/// apart, and what is seen is rarely ground.
const REACH_M: f32 = 128.0;
/// Thickness of a layer, metres: a slope of 15% across a column, and noise.
const LAYER_M: f32 = 0.25;
/// What lies up to this above a layer's bottom tells whether the column is flat, metres. Crowns of
/// trees and bridges are higher.
const ABOVE_M: f32 = 1.25;
/// A layer is no stray reflection if it has this share of the densest layer's points.
const LAYER_SHARE: f32 = 0.2;
/// Nor if it has this many points.
const LAYER_POINTS: usize = 4;

/// A sweep, cut into columns.
pub(super) struct Columns {
    /// The area is |x|, |y| < this, metres.
    pub(super) half_m: f32,
    /// The area's points, column by column, each from low to high: the same order whatever the
    /// order they came in.
    pub(super) points: Vec<Point>,
    /// Columns that have points.
    pub(super) columns: Vec<Column>,
}

/// One column.
pub(super) struct Column {
    /// Its points.
    pub(super) rows: Range<usize>,
    /// The lowest point of its lowest layer.
    pub(super) low: Point,
    in_layer: usize,
    above_layer: usize,
}

impl Column {
    /// Share of the low points that lie in the lowest layer: 1 for flat ground, 0.2 for a wall.
    pub(super) fn flatness(&self) -> f32 {
        self.in_layer as f32 / (self.in_layer + self.above_layer) as f32
    }

    /// Flatness with one point above taken for granted: a single point says little.
    pub(super) fn weight(&self) -> f32 {
        self.in_layer as f32 / (self.in_layer + self.above_layer + 1) as f32
    }

    fn new(points: &[Point], rows: Range<usize>, counts: &mut Vec<usize>) -> Self {
        let column = &points[rows.clone()];
        // Points in the layer that starts at each point.
        counts.clear();
        let mut end = 0;
        for (start, point) in column.iter().enumerate() {
            while column.get(end).is_some_and(|p| p[2] - point[2] < LAYER_M) {
                end += 1;
            }
            counts.push(end.max(start + 1) - start);
        }
        let densest = counts.iter().copied().max().unwrap_or(0);
        let enough = ((densest as f32 * LAYER_SHARE).ceil() as usize).min(LAYER_POINTS);
        let lowest = counts.iter().position(|&count| count >= enough);
        let lowest = lowest.unwrap_or(0);
        let low = column[lowest];
        let rest = &column[lowest + counts[lowest]..];
        let above_layer = rest.iter().take_while(|p| p[2] - low[2] < ABOVE_M).count();
        Self {
            rows,
            low,
            in_layer: counts[lowest],
            above_layer,
        }
    }
}

impl Columns {
    /// Whether a point lies in the area.
    pub(super) fn hold(&self, point: &Point) -> bool {
        reach(point) < self.half_m
    }

    /// Cuts a sweep into columns; points outside the area are left out.
    pub(super) fn new(points: &[Point]) -> Self {
        let farthest = points.iter().map(reach).fold(0.0, f32::max);
        // A point right on the border is outside, hence one tile more.
        let half_m = ((farthest / TILE_M).floor() * TILE_M + TILE_M).min(REACH_M);
        let side = (2.0 * half_m / SIDE_M) as usize;
        let outside = side * side;
        let cell = |point: &Point| {
            if reach(point) < half_m {
                let [u, v] = [0, 1].map(|axis| ((point[axis] + half_m) / SIDE_M) as usize);
                v.min(side - 1) * side + u.min(side - 1)
            } else {
                outside
            }
        };

        // Counting sort by cell, then each cell by height.
        let cells: Vec<usize> = points.iter().map(cell).collect();
        let mut starts = vec![0; outside + 2];
        for &cell in &cells {
            starts[cell + 1] += 1;
        }
        for cell in 0..=outside {
            starts[cell + 1] += starts[cell];
        }
        let mut sorted = vec![[0.0; 3]; points.len()];
        let mut next = starts.clone();
        for (point, &cell) in points.iter().zip(&cells) {
            sorted[next[cell]] = *point;
            next[cell] += 1;
        }
        sorted.truncate(starts[outside]);
        let mut counts = Vec::new();
        let mut columns = Vec::new();
        for cell in 0..outside {
            let rows = starts[cell]..starts[cell + 1];
            if !rows.is_empty() {
                sorted[rows.clone()].sort_unstable_by(low_to_high);
                columns.push(Column::new(&sorted, rows, &mut counts));
            }
        }
        Self {
            half_m,
            points: sorted,
            columns,
        }
    }
}

/// The farther of |x| and |y|, metres.
fn reach(point: &Point) -> f32 {
    point[0].abs().max(point[1].abs())
}

/// By height; equal heights by place.
fn low_to_high(a: &Point, b: &Point) -> std::cmp::Ordering {
    let by = |axis: usize| a[axis].total_cmp(&b[axis]);
    by(2).then(by(0)).then(by(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn column(heights: &[f32]) -> Column {
        let points: Vec<Point> = heights.iter().map(|&z| [3.2, -7.6, z]).collect();
        let mut columns = Columns::new(&points).columns;
        assert_eq!(columns.len(), 1);
        columns.pop().expect("one column")
    }

    #[test]
    fn ground_is_flat_and_a_wall_is_not() {
        let wall: Vec<f32> = (0..40).map(|i| i as f32 * 0.05).collect();
        assert_eq!(column(&[-1.7, -1.72, -1.69]).flatness(), 1.0);
        assert_eq!(column(&wall).flatness(), 0.2);
        assert_eq!(column(&[-1.7, 4.0, 4.1]).flatness(), 1.0);
    }

    #[test]
    fn a_stray_point_below_many_is_not_the_lowest_layer_but_four_are() {
        let mut heights = vec![-1.7; 30];
        heights.push(-4.0);
        assert_eq!(column(&heights).low[2], -1.7);
        heights.extend([-4.0, -3.9, -4.1]);
        assert_eq!(column(&heights).low[2], -4.1);
    }

    #[test]
    fn a_lone_point_is_flat_but_weighs_half() {
        let lone = column(&[0.3]);
        assert_eq!((lone.flatness(), lone.weight()), (1.0, 0.5));
    }

    #[test]
    fn points_outside_the_area_are_left_out() {
        let far = [[128.0, 0.0, 0.0], [0.0, -300.0, 0.0], [1e30, 0.0, 0.0]];
        assert!(Columns::new(&far).columns.is_empty());
        let near = [[-127.9, 127.9, 0.0], [0.0, 0.0, 0.0]];
        assert_eq!(Columns::new(&near).columns.len(), 2);
        assert!(Columns::new(&[]).columns.is_empty());
    }

    #[test]
    fn every_point_of_the_area_is_in_one_column() {
        let points: Vec<Point> = (0..500)
            .map(|i| [(i * 37 % 101) as f32, (i * 53 % 89) as f32, i as f32 * 0.01])
            .collect();
        let columns = Columns::new(&points);
        let mut next = 0;
        for column in &columns.columns {
            assert_eq!(column.rows.start, next);
            next = column.rows.end;
        }
        assert_eq!(next, points.len());
        assert_eq!(columns.points.len(), points.len());
    }
}
