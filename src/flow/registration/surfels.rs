//! Small flat pieces of a cloud's surfaces, and which of them lies nearest to a point.
//!
//! Points lie in square columns, sorted, so that the nine columns around a point are three runs in
//! memory. A surfel is made of a point's neighbors within a cell. It must not know of motions.

use std::ops::Range;
use std::sync::OnceLock;

use rayon::prelude::*;

use crate::flow::data::{Point, floor, get_or_compute, square_distance, stride_sample};
use crate::flow::spatial::{Neighborhood, PlaneFit, REACH};

/// Points whose surfels one thread makes at a time.
const POINTS_AT_ONCE: usize = 256;

/// A flat piece of surface.
#[derive(Clone, Copy)]
pub(super) struct Surfel {
    /// A point on it, metres.
    pub(super) point: Point,
    /// How it lies.
    pub(super) flat: PlaneFit,
}

/// A cloud by place: evenly thinned points, voxels apart that are smaller than a cell.
pub(super) struct Columns {
    cell_m: f32,
    /// Columns that are not empty, by x, then y, and where their points begin; closed by one that
    /// begins at the end.
    columns: Vec<(u64, u32)>,
    points: Vec<Point>,
}

/// A cloud's surfels, as far as they have been asked for.
pub(super) struct Surfels {
    columns: Columns,
    flats: OnceLock<Vec<Option<PlaneFit>>>,
}

/// All of a cloud's surfels.
#[derive(Clone, Copy)]
pub(super) struct AllSurfels<'a> {
    columns: &'a Columns,
    /// One for each of the columns' points; none where there is no flat surface.
    flats: &'a [Option<PlaneFit>],
}

impl Columns {
    /// Normals will be taken, and points will be sought, within `cell_m` metres.
    pub(super) fn new(points: &[Point], cell_m: f32) -> Self {
        let keyed = points.iter().map(|&point| (column(point, cell_m), point));
        let mut keyed: Vec<_> = keyed.collect();
        // Stable: the order within a column is that of the points.
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

    /// The points of the columns around `point`: three runs.
    fn around(&self, point: Point) -> [Range<usize>; 3] {
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
        for row in self.around(point) {
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
    /// Those of a cloud.
    pub(super) fn new(columns: Columns) -> Self {
        Self {
            columns,
            flats: OnceLock::new(),
        }
    }

    /// All of them.
    pub(super) fn all(&self) -> AllSurfels<'_> {
        let columns = &self.columns;
        let flats = get_or_compute(&self.flats, || columns.flats(&columns.points));
        AllSurfels { columns, flats }
    }

    /// Those of at most `most` of the points, evenly; points that lie on no flat surface have none.
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
    /// The surfel whose point is nearest to `point`, less than `within_m` from it, which is at
    /// most a cell; none where nothing or nothing flat is there.
    pub(super) fn nearest(&self, point: Point, within_m: f32) -> Option<Surfel> {
        let near = |c: &f32| (c / self.columns.cell_m).abs() < REACH - 2.0;
        if !point.iter().all(near) {
            return None;
        }
        let points = &self.columns.points;
        let mut nearest = None;
        let mut least = within_m * within_m;
        for row in self.columns.around(point) {
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

/// The column of a point within reach; one cell of room is left around all of them.
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
            let PlaneFit { normal, thickness } = surfels.nearest(point, 1.0).expect("flat").flat;
            let along = Vector3::from(normal.map(f64::from)).dot(&slope).abs();
            assert!(along > 1.0 - 1e-6, "{normal:?}");
            assert!(thickness < 1e-6, "{thickness}");
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
