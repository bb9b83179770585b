//! Column index: radius and nearest-neighbor queries on a point cloud.
//!
//! Points lie in square vertical columns, sorted by height within each. A hash table finds a
//! column. A query within one column side visits at most nine columns.

use std::ops::Range;

use crate::flow::data::{Point, floor, square_distance};

/// Bound on a column's index along an axis, on each side of the origin. Points beyond it share the
/// outermost column.
const REACH: f32 = (1 << 30) as f32;

/// A point cloud indexed by vertical columns.
#[derive(Debug)]
pub(crate) struct ColumnIndex {
    column_m: f32,
    /// Open addressing: the key of a column and the range of its points. An empty range is a vacant
    /// slot.
    table: Vec<(u64, Range<u32>)>,
    /// Sorted by column, then by height.
    points: Vec<Point>,
    /// The input row of each of `points`.
    rows: Vec<u32>,
}

impl ColumnIndex {
    /// Indexes `points`, metres, for queries within `column_m` metres.
    pub(crate) fn new(points: &[Point], column_m: f32) -> Self {
        let keyed = points.iter().zip(0_u32..);
        let mut keyed: Vec<(u64, f32, u32)> = keyed
            .map(|(&point, row)| (key(column_of(point, column_m)), point[2], row))
            .collect();
        keyed.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
        let columns = keyed.chunk_by(|a, b| a.0 == b.0).count();
        let mut table = vec![(0, 0..0); (columns * 2 + 1).next_power_of_two()];
        let mut begin = 0;
        for column in keyed.chunk_by(|a, b| a.0 == b.0) {
            let end = begin + column.len() as u32;
            let mut slot = hash(column[0].0) as usize & (table.len() - 1);
            while !table[slot].1.is_empty() {
                slot = (slot + 1) & (table.len() - 1);
            }
            table[slot] = (column[0].0, begin..end);
            begin = end;
        }
        Self {
            column_m,
            table,
            points: keyed
                .iter()
                .map(|&(_, _, row)| points[row as usize])
                .collect(),
            rows: keyed.iter().map(|&(_, _, row)| row).collect(),
        }
    }

    /// All points in their input order.
    pub(crate) fn in_order(&self) -> Vec<Point> {
        let mut points = vec![[0.0; 3]; self.points.len()];
        for (&row, &point) in self.rows.iter().zip(&self.points) {
            points[row as usize] = point;
        }
        points
    }

    /// Calls `see` with the input row and the coordinates of every point less than `within_m`
    /// metres from `center`. `within_m` is at most a column's side.
    #[inline]
    pub(crate) fn within(&self, center: Point, within_m: f32, mut see: impl FnMut(u32, Point)) {
        self.columns_within(center, within_m, |slots| {
            let rows = self.rows[slots.clone()].iter();
            for (&point, &row) in self.points[slots].iter().zip(rows) {
                if point[2] > center[2] + within_m {
                    break;
                }
                if square_distance(center, point) < within_m * within_m {
                    see(row, point);
                }
            }
        });
    }

    /// Calls `see` with the input row of every point that [`Self::within`] gives and that is not in
    /// `seen`, and adds these points to `seen`.
    pub(crate) fn within_unseen(
        &self,
        center: Point,
        within_m: f32,
        seen: &mut VisitedRows,
        mut see: impl FnMut(u32),
    ) {
        self.columns_within(center, within_m, |mut slots| {
            while let Some(unseen) = seen.next_unseen(slots.clone()) {
                let point = self.points[unseen];
                if point[2] > center[2] + within_m {
                    break;
                }
                if square_distance(center, point) < within_m * within_m {
                    seen.add(unseen);
                    see(self.rows[unseen]);
                }
                slots.start = unseen + 1;
            }
        });
    }

    /// Calls `see` with the range of the points of each column that may lie within `within_m` of
    /// `center`. A range starts at the first point that is high enough.
    #[inline]
    fn columns_within(&self, center: Point, within_m: f32, mut see: impl FnMut(Range<usize>)) {
        let neighbors = Neighbors::of(center, self.column_m);
        for offset in OFFSETS {
            if neighbors.square_gap(offset) > within_m * within_m {
                continue;
            }
            let Range { start, end } = self.column(neighbors.key(offset));
            let column = &self.points[start..end];
            let low = column.partition_point(|point| point[2] < center[2] - within_m);
            see(start + low..end);
        }
    }

    /// The empty set of visited points.
    pub(crate) fn unseen(&self) -> VisitedRows {
        VisitedRows(vec![0; self.points.len().div_ceil(64)])
    }

    /// Calls `see` with every point of the columns that touch the square of half side `half_m`
    /// around `center`, at most `height_m` higher or lower. Metres.
    pub(crate) fn within_square(
        &self,
        center: Point,
        half_m: f32,
        height_m: f32,
        mut see: impl FnMut(Point),
    ) {
        let corner =
            |side: f32| column_of([center[0] + side, center[1] + side, 0.0], self.column_m);
        let ([left, low], [right, high]) = (corner(-half_m), corner(half_m));
        for x in left..=right {
            for y in low..=high {
                let column = &self.points[self.column(key([x, y]))];
                let begin = column.partition_point(|point| point[2] < center[2] - height_m);
                for &point in &column[begin..] {
                    if point[2] > center[2] + height_m {
                        break;
                    }
                    see(point);
                }
            }
        }
    }

    /// The input row and the squared distance of the nearest point that `allowed` accepts, less
    /// than `within_m` metres from `center`. `within_m` is at most a column's side. Of equally near
    /// points, the one of the lowest row is taken.
    #[inline]
    pub(crate) fn nearest(
        &self,
        center: Point,
        within_m: f32,
        allowed: impl Fn(u32) -> bool,
    ) -> Option<(u32, f32)> {
        let neighbors = Neighbors::of(center, self.column_m);
        let mut best: Option<(u32, f32)> = None;
        let mut least = within_m * within_m;
        // The center's own column comes first. Within a column the search runs up and down from the
        // center's height, and ends where the height difference alone is too large.
        for offset in OFFSETS {
            if neighbors.square_gap(offset) > least {
                continue;
            }
            let Range { start, end } = self.column(neighbors.key(offset));
            let column = &self.points[start..end];
            let level = column.partition_point(|point| point[2] < center[2]);
            let mut may_go_on = |slot: usize| {
                let point = column[slot];
                let height = point[2] - center[2];
                let square = square_distance(center, point);
                let row = self.rows[start + slot];
                let is_lower = |(other, _): (u32, f32)| row < other;
                if (square < least || (square == least && best.is_some_and(is_lower)))
                    && allowed(row)
                {
                    least = square;
                    best = Some((row, square));
                }
                height * height <= least
            };
            let _above = (level..column.len()).all(&mut may_go_on);
            let _below = (0..level).rev().all(&mut may_go_on);
        }
        best
    }

    fn column(&self, key: u64) -> Range<usize> {
        let mut slot = hash(key) as usize & (self.table.len() - 1);
        loop {
            let (found, Range { start, end }) = &self.table[slot];
            // No column is empty: an empty range is a vacant slot.
            if start == end {
                return 0..0;
            }
            if *found == key {
                return *start as usize..*end as usize;
            }
            slot = (slot + 1) & (self.table.len() - 1);
        }
    }
}

/// The set of visited points of a [`ColumnIndex`], one bit a point, in the index's order.
pub(crate) struct VisitedRows(Vec<u64>);

impl VisitedRows {
    #[inline]
    fn add(&mut self, slot: usize) {
        self.0[slot / 64] |= 1 << (slot % 64);
    }

    /// The first of the indices `slots` that has not been visited.
    #[inline]
    fn next_unseen(&self, slots: Range<usize>) -> Option<usize> {
        let Range { mut start, end } = slots;
        while start < end {
            let left = !self.0[start / 64] >> (start % 64);
            if left != 0 {
                let first = start + left.trailing_zeros() as usize;
                return (first < end).then_some(first);
            }
            start = (start / 64 + 1) * 64;
        }
        None
    }
}

/// Offsets of the nine columns around a point, its own column first.
const OFFSETS: [[i32; 2]; 9] = [
    [0, 0],
    [-1, 0],
    [0, -1],
    [0, 1],
    [1, 0],
    [-1, -1],
    [-1, 1],
    [1, -1],
    [1, 1],
];

/// The columns around a point, and the distances to their borders.
struct Neighbors {
    slot: [i32; 2],
    /// Along each axis, the squared distances to the preceding and to the following column, square
    /// metres. They are slightly underestimated, since columns are computed in single precision.
    square_gaps: [[f32; 2]; 2],
}

impl Neighbors {
    #[inline]
    fn of(center: Point, column_m: f32) -> Self {
        let gaps = |c: f32| {
            let columns = c / column_m;
            let before_m = (columns - floor(columns)) * column_m;
            let slack_m = 4.0 * f32::EPSILON * (c.abs() + column_m);
            [before_m, column_m - before_m].map(|gap_m| (gap_m - slack_m).max(0.0).powi(2))
        };
        Self {
            slot: column_of(center, column_m),
            square_gaps: [gaps(center[0]), gaps(center[1])],
        }
    }

    /// Lower bound on the squared distance to the column at `offset`, square metres.
    #[inline]
    fn square_gap(&self, offset: [i32; 2]) -> f32 {
        let gap = |axis: usize| match offset[axis] {
            0 => 0.0,
            step => self.square_gaps[axis][usize::from(step > 0)],
        };
        gap(0) + gap(1)
    }

    #[inline]
    fn key(&self, [dx, dy]: [i32; 2]) -> u64 {
        let [x, y] = self.slot;
        key([x + dx, y + dy])
    }
}

/// Indices of the column that a point lies in.
fn column_of(point: Point, column_m: f32) -> [i32; 2] {
    [point[0], point[1]].map(|c| floor(c / column_m).clamp(-REACH, REACH) as i32)
}

fn key([x, y]: [i32; 2]) -> u64 {
    u64::from(x.cast_unsigned()) << 32 | u64::from(y.cast_unsigned())
}

/// Fibonacci hashing: the high bits are mixed best.
fn hash(key: u64) -> u64 {
    key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 29
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;

    #[test]
    fn the_nearest_point_is_the_one_that_a_search_of_all_finds() {
        let mut random = Random::new(2);
        let mut point = || [0; 3].map(|_| random.uniform(-3.0, 3.0) as f32);
        let cloud: Vec<Point> = (0..700).map(|_| point()).collect();
        let near = ColumnIndex::new(&cloud, 0.7);
        for _ in 0..500 {
            let asked = point();
            let allowed = |row: u32| !row.is_multiple_of(3);
            let all = cloud.iter().zip(0..).filter(|&(_, row)| allowed(row));
            let least = all.map(|(&other, row)| (square_distance(asked, other), row));
            let least = least.min_by(|a, b| a.0.total_cmp(&b.0));
            let expected = least.filter(|&(square, _)| square < 0.49);
            let found = near.nearest(asked, 0.7, allowed);
            assert_eq!(found, expected.map(|(square, row)| (row, square)));
        }
    }

    #[test]
    fn on_a_lattice_far_out_the_nearest_is_the_lowest_row_of_equals_and_nothing_near_is_left_out() {
        // Column borders pass through the points, and single precision resolves a quarter of a
        // millimetre.
        let lattice = |i: u16| {
            let [x, y, z] = [i % 12, i / 12 % 12, i / 144].map(f32::from);
            [4000.0 + x * 0.25, -4000.0 + y * 0.25, z * 0.25]
        };
        let cloud: Vec<Point> = (0..720).map(lattice).collect();
        let near = ColumnIndex::new(&cloud, 0.5);
        let mut random = Random::new(5);
        for _ in 0..500 {
            let mut side = |low: f64, high: f64| (random.uniform(low, high) * 8.0).round() / 8.0;
            let asked = [
                side(3999.5, 4003.5),
                side(-4000.5, -3996.5),
                side(-0.5, 1.5),
            ];
            let asked = asked.map(|c| c as f32);
            for within_m in [0.2, 0.5_f32] {
                let square = |&point: &Point| square_distance(asked, point);
                let inside = |&(square, _): &(f32, u32)| square < within_m * within_m;
                let all = cloud.iter().map(square).zip(0..).filter(inside);
                let mut all: Vec<(f32, u32)> = all.collect();
                let mut within = Vec::new();
                near.within(asked, within_m, |row, _| within.push(row));
                within.sort_unstable();
                let rows: Vec<u32> = all.iter().map(|&(_, row)| row).collect();
                assert_eq!(within, rows);
                all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                let first = all.first().map(|&(square, row)| (row, square));
                assert_eq!(near.nearest(asked, within_m, |_| true), first);
            }
        }
    }

    #[test]
    fn what_lies_near_several_places_is_seen_once_and_nothing_of_it_is_left_out() {
        let mut random = Random::new(6);
        let mut point = || [0; 3].map(|_| random.uniform(-3.0, 3.0) as f32);
        let cloud: Vec<Point> = (0..3000).map(|_| point()).collect();
        let near = ColumnIndex::new(&cloud, 0.7);
        let slots: Vec<Point> = (0..40).map(|_| point()).collect();
        let (mut seen, mut rows) = (near.unseen(), Vec::new());
        for &slot in &slots {
            near.within_unseen(slot, 0.7, &mut seen, |row| rows.push(row));
        }
        rows.sort_unstable();
        let is_near = |point: &Point| slots.iter().any(|&p| square_distance(p, *point) < 0.49);
        let expected = cloud.iter().zip(0..).filter(|(point, _)| is_near(point));
        let expected: Vec<u32> = expected.map(|(_, row)| row).collect();
        assert!(expected.len() > 500);
        assert_eq!(rows, expected);
    }

    #[test]
    fn a_square_holds_what_a_search_of_all_finds_in_it() {
        let mut random = Random::new(3);
        let mut point = || [0; 3].map(|_| random.uniform(-3.0, 3.0) as f32);
        let cloud: Vec<Point> = (0..700).map(|_| point()).collect();
        let near = ColumnIndex::new(&cloud, 0.4);
        let asked = point();
        let inside = |other: &Point, half_m: f32| {
            (0..2).all(|a| (other[a] - asked[a]).abs() <= half_m)
                && (other[2] - asked[2]).abs() <= 0.5
        };
        let mut seen = 0;
        near.within_square(asked, 1.5, 0.5, |other| {
            assert!(inside(&other, 1.5 + 0.4), "{other:?}");
            seen += usize::from(inside(&other, 1.5));
        });
        let expected = cloud.iter().filter(|other| inside(other, 1.5)).count();
        assert_eq!(seen, expected);
    }

    #[test]
    fn nothing_is_near_in_an_empty_cloud_and_far_from_every_point() {
        assert_eq!(
            ColumnIndex::new(&[], 0.5).nearest([0.0; 3], 0.5, |_| true),
            None
        );
        let near = ColumnIndex::new(&[[1e30, -1e30, 0.0]], 0.5);
        assert_eq!(near.nearest([0.0; 3], 0.5, |_| true), None);
        assert_eq!(near.nearest([f32::NAN; 3], 0.5, |_| true), None);
    }
}
