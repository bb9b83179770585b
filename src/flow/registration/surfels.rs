//! Surfels: small flat patches of a cloud's surfaces, and a nearest-neighbor search over them.
//!
//! Points lie in sorted square columns, so that the nine columns around a point are three
//! contiguous ranges in memory. A surfel is fitted to the neighbors of a point within a cell's
//! side.

use std::ops::Range;
use std::sync::OnceLock;

use rayon::prelude::*;

use crate::flow::data::{Point, floor, get_or_compute, square_distance, stride_sample};
use crate::flow::spatial::{Neighborhood, PlaneFit, REACH};

/// Points whose surfels one thread computes at a time.
const POINTS_AT_ONCE: usize = 256;

/// A flat patch of surface.
#[derive(Clone, Copy)]
pub(super) struct Surfel {
    /// The point of the cloud that it is centered on, metres.
    pub(super) point: Point,
    /// The plane fitted to the neighbors of `point`.
    pub(super) flat: PlaneFit,
}

/// A voxel-downsampled cloud in square columns. The voxels are smaller than a cell.
pub(super) struct Columns {
    cell_m: f32,
    /// Columns that are not empty, by x and then y, with the index of the first point of each. A
    /// sentinel that begins at the end closes the list.
    columns: Vec<(u64, u32)>,
    points: Vec<Point>,
}

/// The surfels of a cloud, computed on first use.
pub(super) struct Surfels {
    columns: Columns,
    flats: OnceLock<Vec<Option<PlaneFit>>>,
}

/// All surfels of a cloud.
#[derive(Clone, Copy)]
pub(super) struct AllSurfels<'a> {
    columns: &'a Columns,
    /// One for each of the columns' points; none where the surface is not flat.
    flats: &'a [Option<PlaneFit>],
}

impl Columns {
    /// Sorts `points`, metres, into columns for normals and matches within `cell_m` metres.
    pub(super) fn new(points: &[Point], cell_m: f32) -> Self {
        let keyed = points.iter().map(|&point| (column(point, cell_m), point));
        let mut keyed: Vec<_> = keyed.collect();
        // The sort is stable and keeps the points' order within a column.
        keyed.sort_by_key(|&(key, _)| key);
        let mut columns: Vec<(u64, u32)> = Vec::new();
        for (&(key, _), begin) in keyed.iter().zip(0..) {
            if columns.last().is_none_or(|&(last, _)| last != key) {
                columns.push((key, begin));
            }
        }
        columns.push((u64::MAX, keyed.len() as u32));
        Self {
            cell_m,
            columns,
            points: keyed.into_iter().map(|(_, point)| point).collect(),
        }
    }

    fn flats(&self, points: &[Point]) -> Vec<Option<PlaneFit>> {
        let chunks = points.par_chunks(POINTS_AT_ONCE);
        let flats = chunks.flat_map_iter(|points| points.iter().map(|&point| self.flat_at(point)));
        flats.collect()
    }

    /// The points of the nine columns around `point`: three ranges.
    fn within(&self, point: Point) -> [Range<usize>; 3] {
        let middle = column(point, self.cell_m);
        let (x, y) = (middle >> 32, middle & u64::from(u32::MAX));
        let begin = |x: u64, y: u64| {
            let first = self
                .columns
                .partition_point(|&(key, _)| key < (x << 32 | y));
            self.columns[first].1 as usize
        };
        [x - 1, x, x + 1].map(|x| begin(x, y - 1)..begin(x, y + 2))
    }

    fn flat_at(&self, point: Point) -> Option<PlaneFit> {
        let mut neighborhood = Neighborhood::of(point);
        for row in self.within(point) {
            for &other in &self.points[row] {
                if square_distance(point, other) < self.cell_m * self.cell_m {
                    neighborhood.add(other);
                }
            }
        }
        neighborhood.flat()
    }
}

impl Surfels {
    /// Surfels of the points in `columns`.
    pub(super) fn new(columns: Columns) -> Self {
        Self {
            columns,
            flats: OnceLock::new(),
        }
    }

    /// All surfels.
    pub(super) fn all(&self) -> AllSurfels<'_> {
        let columns = &self.columns;
        let flats = get_or_compute(&self.flats, || columns.flats(&columns.points));
        AllSurfels { columns, flats }
    }

    /// The surfels of at most `most` points, chosen evenly. Points on no flat surface have none.
    pub(super) fn some(&self, most: usize) -> Vec<Surfel> {
        let points = stride_sample(&self.columns.points, most);
        let flats = match self.flats.get() {
            Some(flats) => stride_sample(flats, most),
            None => self.columns.flats(&points),
        };
        let surfels = points.into_iter().zip(flats);
        let surfels = surfels.filter_map(|(point, flat)| Some(Surfel { point, flat: flat? }));
        surfels.collect()
    }
}

impl AllSurfels<'_> {
    /// The surfel whose point is nearest to `point` and less than `within_m` metres from it;
    /// `within_m` is at most a cell's side. None where there is no such point, or where its surface
    /// is not flat.
    pub(super) fn nearest(&self, point: Point, within_m: f32) -> Option<Surfel> {
        let near = |c: &f32| (c / self.columns.cell_m).abs() < REACH - 2.0;
        if !point.iter().all(near) {
            return None;
        }
        let points = &self.columns.points;
        let mut nearest = None;
        let mut least = within_m * within_m;
        for row in self.columns.within(point) {
            for (other, i) in points[row.clone()].iter().zip(row) {
                let square = square_distance(point, *other);
                if square < least {
                    least = square;
                    nearest = Some(i);
                }
            }
        }
        let nearest = nearest?;
        Some(Surfel {
            point: points[nearest],
            flat: self.flats[nearest]?,
        })
    }
}

/// The key of the column of a point within range. One column of margin is left around all of them.
fn column(point: Point, cell_m: f32) -> u64 {
    let [x, y] = [point[0], point[1]].map(|c| (floor(c / cell_m) + REACH + 1.0) as u64);
    x << 32 | y
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::flow::data::Random;

    #[test]
    fn the_nearest_surfel_is_the_one_that_a_search_of_all_finds() {
        let mut random = Random::new(2);
        let mut point = || [0; 3].map(|_| random.uniform(-4.0, 4.0) as f32);
        let cloud: Vec<Point> = (0..800).map(|_| point()).collect();
        let surfels = Surfels::new(Columns::new(&cloud, 1.0));
        let surfels = surfels.all();
        for _ in 0..500 {
            let asked = point();
            let square = |other: &Point| square_distance(asked, *other);
            let nearest = cloud.iter().map(square).fold(f32::INFINITY, f32::min);
            if let Some(found) = surfels.nearest(asked, 1.0) {
                assert_eq!(square(&found.point), nearest);
            }
        }
        assert!(surfels.nearest([f32::NAN; 3], 1.0).is_none());
        assert!(surfels.nearest([1e30, 0.0, 0.0], 1.0).is_none());
    }

    #[test]
    fn planes_have_their_normal_and_lines_have_none() {
        let slope = Vector3::new(0.3, -0.2, 1.0).normalize();
        let on_plane = |i: usize| {
            let [x, y] = [(i % 20) as f32 * 0.3 - 3.0, (i / 20) as f32 * 0.3 - 3.0];
            [x, y, -0.3 * x + 0.2 * y]
        };
        let plane: Vec<Point> = (0..400).map(on_plane).collect();
        let surfels = Surfels::new(Columns::new(&plane, 1.0));
        let surfels = surfels.all();
        for &point in &plane {
            let found = surfels.nearest(point, 1.0).expect("flat").flat;
            let PlaneFit {
                normal, thickness, ..
            } = found;
            let along = Vector3::from(normal.map(f64::from)).dot(&slope).abs();
            assert!(along > 1.0 - 1e-6, "{normal:?}");
            assert!(thickness < 0.01, "{thickness}");
        }
        let line: Vec<Point> = (0..100).map(|i| [i as f32 * 0.3, 0.0, 0.0]).collect();
        let line = Surfels::new(Columns::new(&line, 1.0));
        assert!(line.some(100).is_empty());
        let nothing = Surfels::new(Columns::new(&[], 1.0));
        assert!(nothing.all().nearest([0.0; 3], 1.0).is_none());
    }

    #[test]
    fn some_surfels_are_the_same_whether_all_have_been_asked_for_or_not() {
        let mut random = Random::new(3);
        let mut point = || [4.0, 4.0, 0.1].map(|side| random.uniform(-side, side) as f32);
        let cloud: Vec<Point> = (0..900).map(|_| point()).collect();
        let surfels = Surfels::new(Columns::new(&cloud, 1.0));
        let bits = |some: Vec<Surfel>| -> Vec<_> {
            let some = some.into_iter();
            some.map(|Surfel { point, flat }| (point, flat.normal, flat.thickness))
                .collect()
        };
        let before = bits(surfels.some(200));
        surfels.all();
        assert!(before.len() > 100);
        assert_eq!(bits(surfels.some(200)), before);
    }
}
