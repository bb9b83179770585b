//! DBSCAN clustering (Ester et al. 1996) on a grid.
//!
//! The diagonal of a cell is the radius, so that all points of a cell lie within the radius of each
//! other. A cell with enough points holds core points only, without a distance computation.

use std::borrow::Cow;
use std::ops::Range;

use rayon::prelude::*;

use super::key_table::KeyTable;
use super::voxel::voxel_first;
use crate::flow::data::{Point, floor, square_distance};

/// Number of core points in a cell above which they are voxel-downsampled. The voxel side is the
/// radius over `VOXELS`.
const FULL: usize = 64;
const VOXELS: f32 = 16.0;
/// Points of a lidar sweep in a cell, or fewer.
const EXPECTED: usize = 2;
/// Parts of the grid that are connected each by itself.
const PARTS: usize = 32;

/// Label of a point that belongs to no cluster.
pub(crate) const NOISE: u32 = u32::MAX;

/// DBSCAN clusters of `points`, metres: N labels, numbered from 0 in the order of each cluster's
/// first point, or [`NOISE`]. A point with at least `least` points within `radius_m` metres, itself
/// included, is a core point. Core points within the radius of each other are in one cluster. Any
/// other point within the radius of a core point joins the cluster of the nearest one. Points
/// farther out than about 2^20 cells along an axis are noise.
pub(crate) fn clusters(points: &[Point], radius_m: f32, least: usize) -> Vec<u32> {
    let grid = Cells::new(points, radius_m / 3_f32.sqrt());
    let square = radius_m * radius_m;
    let cores: Vec<Cow<'_, [u32]>> = (0..grid.len())
        .into_par_iter()
        .map(|cell| {
            let members = grid.members(cell);
            if members.len() < least {
                Cow::Owned(grid.cores(cell, square, least))
            } else if members.len() <= FULL {
                Cow::Borrowed(members)
            } else {
                Cow::Owned(few(points, members, radius_m))
            }
        })
        .collect();
    let root = connected(&grid, &cores, square);
    // A core point takes the set of its cell, any other point that of the nearest core point.
    let mut labels = vec![NOISE; points.len()];
    let mut others: Vec<(usize, u32)> = Vec::new();
    for (cell, &root) in root.iter().enumerate() {
        let members = grid.members(cell);
        let mut cores = cores[cell].iter().peekable();
        for &row in members {
            if members.len() >= least || cores.next_if_eq(&&row).is_some() {
                labels[row as usize] = root;
            } else {
                others.push((cell, row));
            }
        }
    }
    let distance = |a: u32, b: u32| square_distance(points[a as usize], points[b as usize]);
    let beside = |&(cell, row): &(usize, u32)| {
        let mut best = (f32::INFINITY, NOISE);
        for other in grid.within(cell) {
            for &core in cores[other].iter() {
                let far = distance(row, core);
                if far <= square && far < best.0 {
                    best = (far, root[other]);
                }
            }
        }
        best.1
    };
    let found: Vec<u32> = others.par_iter().map(beside).collect();
    for (&(_, row), label) in others.iter().zip(found) {
        labels[row as usize] = label;
    }
    renumber(&mut labels, grid.len());
    labels
}

/// Of each cell the root of its set. Cells are in one set if a chain of core points, each within the
/// radius of the next, connects them.
fn connected(grid: &Cells<'_>, cores: &[Cow<'_, [u32]>], square: f32) -> Vec<u32> {
    let touches = |cell: usize, other: usize| {
        let distance = |a: u32, b: u32| {
            let [a, b] = [a, b].map(|row| grid.points[row as usize]);
            square_distance(a, b)
        };
        let near = |&a: &u32| cores[other].iter().any(|&b| distance(a, b) <= square);
        cores[cell].iter().any(near)
    };
    // The relation is symmetric, so later cells suffice. Cells that are connected already are not
    // compared, which spares most pairs.
    let part = grid.len().div_ceil(PARTS).max(1);
    let parts: Vec<(Sets, Vec<(usize, usize)>)> = (0..PARTS)
        .into_par_iter()
        .map(|number| {
            let first = number * part;
            let end = (first + part).min(grid.len());
            let mut inside = Sets::new(end.saturating_sub(first));
            let mut across = Vec::new();
            for cell in (first..end).filter(|&cell| !cores[cell].is_empty()) {
                for other in grid.within(cell).filter(|&other| other > cell) {
                    if other >= end {
                        if touches(cell, other) {
                            across.push((cell, other));
                        }
                    } else {
                        let [a, b] = [cell, other].map(|cell| (cell - first) as u32);
                        if inside.root(a) != inside.root(b) && touches(cell, other) {
                            inside.join(a, b);
                        }
                    }
                }
            }
            (inside, across)
        })
        .collect();
    let mut sets = Sets::new(grid.len());
    for (number, (mut inside, across)) in parts.into_iter().enumerate() {
        let first = (number * part) as u32;
        for cell in 0..inside.0.len() as u32 {
            sets.join(first + cell, first + inside.root(cell));
        }
        for (cell, other) in across {
            sets.join(cell as u32, other as u32);
        }
    }
    (0..grid.len() as u32).map(|cell| sets.root(cell)).collect()
}

/// One row for each small voxel, which bounds the time to compare two full cells. Cells that touch by less than a voxel may then stay separate.
fn few(points: &[Point], rows: &[u32], radius_m: f32) -> Vec<u32> {
    let of_cell: Vec<Point> = rows.iter().map(|&row| points[row as usize]).collect();
    let kept = voxel_first(&of_cell, radius_m / VOXELS);
    kept.into_iter().map(|i| rows[i as usize]).collect()
}

/// Renumbers labels from 0 in the order of their first occurrence.
fn renumber(labels: &mut [u32], roots: usize) {
    let mut numbers = vec![NOISE; roots];
    let mut next = 0;
    for label in labels.iter_mut().filter(|label| **label != NOISE) {
        let number = &mut numbers[*label as usize];
        if *number == NOISE {
            *number = next;
            next += 1;
        }
        *label = *number;
    }
}

/// Points in cubic cells.
struct Cells<'a> {
    points: &'a [Point],
    /// Key of each cell and the index of its first member in `rows`, sorted by key. A sentinel closes
    /// the list.
    cells: Vec<(u64, u32)>,
    rows: Vec<u32>,
    columns: Vec<Column>,
    /// The column of each cell.
    column_of: Vec<u32>,
}

/// The cells of one x and y.
struct Column {
    /// A cell's key without the height.
    key: u64,
    cells: Range<u32>,
    /// For each x from two cells before to two cells after, the columns from two cells before to two
    /// cells after in y.
    around: [Range<u32>; 5],
}

/// Bound on a cell's index along an axis, on each side of the origin.
const REACH: f32 = (1 << 20) as f32 - 4.0;
/// Bits of a key for each axis; the height has the lowest.
const HEIGHT: u64 = 21;

impl<'a> Cells<'a> {
    fn new(points: &'a [Point], side_m: f32) -> Self {
        // Points out of range belong to no cell.
        let in_reach = |&row: &u32| {
            let point = points[row as usize];
            point.iter().all(|c| (c / side_m).abs() < REACH)
        };
        let rows: Vec<u32> = (0..points.len() as u32).filter(in_reach).collect();
        let keys: Vec<u64> = rows
            .iter()
            .map(|&row| key(points[row as usize], side_m))
            .collect();
        let mut table = KeyTable::<u32>::new(points.len() / EXPECTED);
        for &key in &keys {
            *table.entry(key) += 1;
        }
        // Counting sort: the number of a cell's members becomes the place of the next one.
        let mut cells: Vec<(u64, u32)> = Vec::new();
        let mut next = 0;
        for key in table.sorted() {
            cells.push((key, next));
            let members = table.entry(key);
            next += core::mem::replace(members, next);
        }
        cells.push((u64::MAX, next));
        let mut sorted = vec![0; rows.len()];
        for (&row, &key) in rows.iter().zip(&keys) {
            let place = table.entry(key);
            sorted[*place as usize] = row;
            *place += 1;
        }
        let (columns, column_of) = columns(&cells[..cells.len() - 1]);
        Self {
            points,
            cells,
            rows: sorted,
            columns,
            column_of,
        }
    }

    /// Number of cells.
    fn len(&self) -> usize {
        self.cells.len() - 1
    }

    fn members(&self, cell: usize) -> &[u32] {
        &self.rows[self.cells[cell].1 as usize..self.cells[cell + 1].1 as usize]
    }

    /// The cells that may hold points within the radius of this cell's points, this cell included,
    /// in ascending order.
    fn within(&self, cell: usize) -> impl Iterator<Item = usize> {
        let height = |key: u64| key & ((1 << HEIGHT) - 1);
        let z = height(self.cells[cell].0);
        let around = &self.columns[self.column_of[cell] as usize].around;
        let columns = around
            .iter()
            .flat_map(|range| &self.columns[range.start as usize..range.end as usize]);
        columns.flat_map(move |column| {
            let range = column.cells.start as usize..column.cells.end as usize;
            let cells = &self.cells[range.clone()];
            let low = range.start + cells.partition_point(|&(key, _)| height(key) + 2 < z);
            let is_near = move |&cell: &usize| height(self.cells[cell].0) <= z + 2;
            (low..range.end).take_while(is_near)
        })
    }

    /// The core points among a cell's members: those with `least` points within the radius.
    fn cores(&self, cell: usize, square: f32, least: usize) -> Vec<u32> {
        let is_core = |&row: &u32| {
            let near = self.within(cell).flat_map(|other| self.members(other));
            near.filter(|&&other| {
                square_distance(self.points[row as usize], self.points[other as usize]) <= square
            })
            .take(least)
            .count()
                >= least
        };
        self.members(cell).iter().copied().filter(is_core).collect()
    }
}

/// The columns of the sorted `cells`, and the column of each cell.
fn columns(cells: &[(u64, u32)]) -> (Vec<Column>, Vec<u32>) {
    let mut columns: Vec<Column> = Vec::new();
    let mut column_of = Vec::with_capacity(cells.len());
    for (&(key, _), cell) in cells.iter().zip(0..) {
        let key = key >> HEIGHT;
        match columns.last_mut() {
            Some(last) if last.key == key => last.cells.end = cell + 1,
            _ => columns.push(Column {
                key,
                cells: cell..cell + 1,
                around: core::array::from_fn(|_| 0..0),
            }),
        }
        column_of.push(columns.len() as u32 - 1);
    }
    // The columns ascend, and so do the columns around them.
    for (offset, dx) in (-2_i64..=2).enumerate() {
        let (mut begin, mut end) = (0, 0);
        for column in 0..columns.len() {
            let middle = columns[column].key.wrapping_add_signed(dx << HEIGHT);
            while columns.get(begin).is_some_and(|c| c.key < middle - 2) {
                begin += 1;
            }
            while columns.get(end).is_some_and(|c| c.key <= middle + 2) {
                end += 1;
            }
            columns[column].around[offset] = begin as u32..end as u32;
        }
    }
    (columns, column_of)
}

fn key(point: Point, side_m: f32) -> u64 {
    let at = |c: f32| (floor(c / side_m).clamp(-REACH, REACH) + REACH + 4.0) as u64;
    at(point[0]) << (2 * HEIGHT) | at(point[1]) << HEIGHT | at(point[2])
}

/// Union-find over cells; the lowest index is the root of its set.
struct Sets(Vec<u32>);

impl Sets {
    fn new(count: usize) -> Self {
        Self((0..count as u32).collect())
    }

    fn root(&mut self, mut member: u32) -> u32 {
        while self.0[member as usize] != member {
            let above = self.0[self.0[member as usize] as usize];
            self.0[member as usize] = above;
            member = above;
        }
        member
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;

    /// DBSCAN by its definition: the core flags, and the labels of the core points. All other
    /// points are labelled noise.
    fn by_definition(points: &[Point], radius_m: f32, least: usize) -> (Vec<bool>, Vec<u32>) {
        let near =
            |a: usize, b: usize| square_distance(points[a], points[b]) <= radius_m * radius_m;
        let count = |a: usize| (0..points.len()).filter(|&b| near(a, b)).count();
        let core: Vec<bool> = (0..points.len()).map(|a| count(a) >= least).collect();
        let mut labels = vec![NOISE; points.len()];
        let mut clusters = 0;
        for seed in 0..points.len() {
            if !core[seed] || labels[seed] != NOISE {
                continue;
            }
            let mut open = vec![seed];
            labels[seed] = clusters;
            while let Some(a) = open.pop() {
                for b in 0..points.len() {
                    if core[b] && labels[b] == NOISE && near(a, b) {
                        labels[b] = clusters;
                        open.push(b);
                    }
                }
            }
            clusters += 1;
        }
        (core, labels)
    }

    #[test]
    fn cores_are_clustered_as_defined_and_others_join_a_core_within_the_radius() {
        for (seed, side) in [(1, 3.0), (2, 5.0), (3, 8.0)] {
            let mut random = Random::new(seed);
            let mut point = || [0; 3].map(|_| random.uniform(0.0, side) as f32);
            let points: Vec<Point> = (0..400).map(|_| point()).collect();
            let (core, expected) = by_definition(&points, 0.5, 4);
            let found = clusters(&points, 0.5, 4);
            let cores: Vec<usize> = (0..points.len()).filter(|&i| core[i]).collect();
            for &a in &cores {
                for &b in &cores {
                    assert_eq!(found[a] == found[b], expected[a] == expected[b]);
                }
            }
            for i in (0..points.len()).filter(|&i| !core[i]) {
                let beside = cores
                    .iter()
                    .filter(|&&c| square_distance(points[i], points[c]) <= 0.25);
                let beside: Vec<u32> = beside.map(|&c| found[c]).collect();
                assert_eq!(found[i] == NOISE, beside.is_empty(), "{i}");
                assert!(found[i] == NOISE || beside.contains(&found[i]), "{i}");
            }
        }
    }

    #[test]
    fn a_pole_of_many_cells_and_points_out_of_reach_take_no_longer_than_others() {
        // A column of 200,000 cells: scanning the column for each of them would take 4e10 steps.
        let mut points: Vec<Point> = (0..200_000).map(|i| [1.0, 2.0, i as f32 * 0.3]).collect();
        // Also 200,000 points out of range, which all belong to the outermost cell if clamped.
        points.extend((0..200_000).map(|i| [9e5, 9e5, i as f32 * 0.5]));
        let found = clusters(&points, 0.5, 2);
        assert!(found[..200_000].iter().all(|&label| label == 0));
        assert!(found[200_000..].iter().all(|&label| label == NOISE));
    }

    #[test]
    fn clusters_are_numbered_in_the_order_of_their_first_point() {
        let mut points = vec![[9.0, 0.0, 0.0]];
        points.extend(vec![[5.0, 0.0, 0.0]; 4]);
        points.extend(vec![[-5.0, 0.0, 0.0]; 4]);
        let expected = [NOISE, 0, 0, 0, 0, 1, 1, 1, 1];
        assert_eq!(clusters(&points, 0.5, 4), expected);
        assert_eq!(clusters(&[], 0.5, 4), [0; 0]);
    }

    #[test]
    fn full_cells_that_do_not_touch_are_told_apart_in_time() {
        // Comparing all pairs of core points of neighboring full cells would take billions of
        // distances.
        let mut random = Random::new(5);
        let mut clump = |x: f64| -> Vec<Point> {
            let mut side = || random.uniform(0.0, 0.25) as f32;
            let clump = (0..40_000).map(|_| [side() + x as f32, side(), side()]);
            clump.collect()
        };
        let points = [clump(0.0), clump(0.8)].concat();
        let labels = clusters(&points, 0.5, 4);
        assert!(labels[..40_000].iter().all(|&label| label == 0));
        assert!(labels[40_000..].iter().all(|&label| label == 1));
    }

    #[test]
    fn many_points_in_one_place_are_one_cluster() {
        let points = vec![[1.0, 2.0, 3.0]; 130_000];
        assert!(clusters(&points, 0.5, 4).iter().all(|&label| label == 0));
    }
}
