//! A sweep divided into vertical columns of 1 m x 1 m, with the lowest layer of each.
//!
//! In a column of ground nearly all points lie in one thin layer. A wall or a bush has points above
//! that layer as well.

use std::ops::Range;

use crate::flow::data::Point;

/// Side of a column, metres.
const SIDE_M: f32 = 1.0;
/// Granularity of the area, metres: its half extent is a multiple of this.
pub(super) const TILE_M: f32 = 32.0;
/// Largest half extent of the area along x and y, metres. Farther out the rings are tens of metres
/// apart, and few of the points are ground.
const REACH_M: f32 = 128.0;
/// Thickness of a layer, metres: room for a slope of 15% across a column, and for noise.
const LAYER_M: f32 = 0.25;
/// Height above a layer's bottom up to which points count in the flatness test, metres. Tree crowns
/// and bridges are higher.
const ABOVE_M: f32 = 1.25;
/// Share of the densest layer's points from which a layer is accepted and not rejected as a stray
/// reflection.
const LAYER_SHARE: f32 = 0.2;
/// Number of points from which a layer is accepted in any case.
const LAYER_POINTS: usize = 4;

/// A sweep divided into columns.
pub(super) struct Columns {
    /// Half extent of the area, metres: |x|, |y| < `half_m`.
    pub(super) half_m: f32,
    /// The points in the area, column by column, and from low to high within each. Their order does
    /// not depend on the input order.
    pub(super) points: Vec<Point>,
    /// The columns that hold points.
    pub(super) columns: Vec<Column>,
}

/// One column.
pub(super) struct Column {
    /// Indices of its points in `Columns::points`.
    pub(super) rows: Range<usize>,
    /// The lowest point of its lowest layer.
    pub(super) low: Point,
    in_layer: usize,
    above_layer: usize,
}

impl Column {
    /// Share of the points up to 1.25 m above the lowest layer's bottom that lie in this layer: 1
    /// for flat ground, 0.2 for a wall.
    pub(super) fn flatness(&self) -> f32 {
        self.in_layer as f32 / (self.in_layer + self.above_layer) as f32
    }

    /// Flatness with one additional point assumed above the layer, so that columns of few points
    /// weigh less.
    pub(super) fn weight(&self) -> f32 {
        self.in_layer as f32 / (self.in_layer + self.above_layer + 1) as f32
    }

    fn new(points: &[Point], rows: Range<usize>, counts: &mut Vec<usize>) -> Self {
        let column = &points[rows.clone()];
        // Number of points in the layer that starts at each point.
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
    pub(super) fn contains(&self, point: &Point) -> bool {
        reach(point) < self.half_m
    }

    /// Divides a sweep into columns. Points outside the area are dropped.
    pub(super) fn new(points: &[Point]) -> Self {
        let farthest = points.iter().map(reach).fold(0.0, f32::max);
        // A point exactly on the border is outside, hence the additional tile.
        let half_m = ((farthest / TILE_M).floor() * TILE_M + TILE_M).min(REACH_M);
        let side = (2.0 * half_m / SIDE_M) as usize;
        let outside = side * side;
        let cell = |point: &Point| {
            if reach(point) < half_m {
                // Never negative, and a conversion to 32 bits takes one instruction.
                let index = |c: f32| (((c + half_m) / SIDE_M) as u32 as usize).min(side - 1);
                index(point[1]) * side + index(point[0])
            } else {
                outside
            }
        };

        // Counting sort by cell, then a sort by height within each cell.
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

/// The larger of |x| and |y|, metres.
fn reach(point: &Point) -> f32 {
    point[0].abs().max(point[1].abs())
}

/// Order by height, then by x, then by y.
fn low_to_high(a: &Point, b: &Point) -> std::cmp::Ordering {
    let by = |axis: usize| a[axis].total_cmp(&b[axis]);
    by(2).then_with(|| by(0)).then_with(|| by(1))
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
