//! DBSCAN clustering (Ester et al. 1996) on a grid.
//!
//! The diagonal of a cell is the radius, so that all points of a cell lie within the radius of each
//! other. A cell with enough points holds core points only, without a distance computation.

use std::borrow::Cow;
use std::ops::Range;

use rayon::prelude::*;

use super::key_table::KeyTable;
use super::voxel::voxel_first;
use crate::flow::data::{Point, floors, square_distance};

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

/// The rows of each cluster, in order, from the `labels` of N points as [`clusters`] gives them.
pub(crate) fn members(labels: &[u32]) -> Vec<Vec<u32>> {
    let clusters = labels.iter().filter(|&&label| label != NOISE).max();
    let mut members = vec![Vec::new(); clusters.map_or(0, |&last| last as usize + 1)];
    for (row, &label) in (0..).zip(labels) {
        if label != NOISE {
            members[label as usize].push(row);
        }
    }
    members
}

/// DBSCAN clusters of `points`, metres: N labels, numbered from 0 in the order of each cluster's
/// first point, or [`NOISE`]. A point with at least `least` points within `radius_m` metres, itself
/// included, is a core point. Core points within the radius of each other are in one cluster. Any
/// other point within the radius of a core point joins the cluster of the nearest one. Points
/// farther out than about 2^20 cells along an axis are noise.
pub(crate) fn clusters(points: &[Point], radius_m: f32, least: usize) -> Vec<u32> {
    let grid = Cells::new(points, radius_m / 3_f32.sqrt());
    let square = radius_m * radius_m;
    let chosen: Vec<Cow<'_, [u32]>> = (0..grid.len())
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
    let cores = CorePoints::new(points, &chosen);
    let root = connected(&grid, &cores, square);
    // A core point takes the set of its cell, any other point that of the nearest core point.
    let mut labels = vec![NOISE; points.len()];
    let mut others: Vec<(usize, u32)> = Vec::new();
    for (cell, &root) in root.iter().enumerate() {
        let members = grid.members(cell);
        let mut cores = chosen[cell].iter().peekable();
        for &row in members {
            if members.len() >= least || cores.next_if_eq(&&row).is_some() {
                labels[row as usize] = root;
            } else {
                others.push((cell, row));
            }
        }
    }
    let beside = |&(cell, row): &(usize, u32)| {
        let position = points[row as usize];
        let mut best = (f32::INFINITY, NOISE);
        grid.each_near(cell, 0, |near| {
            for other in near {
                for &core in cores.of(other) {
                    let far = square_distance(position, core);
                    if far <= square && far < best.0 {
                        best = (far, root[other]);
                    }
                }
            }
        });
        best.1
    };
    let found: Vec<u32> = others.par_iter().map(beside).collect();
    for (&(_, row), label) in others.iter().zip(found) {
        labels[row as usize] = label;
    }
    renumber(&mut labels, grid.len());
    labels
}

/// The core points, cell by cell.
struct CorePoints {
    points: Vec<Point>,
    /// Index of the first core point of each cell, and the number of core points at the end.
    begins: Vec<u32>,
}

impl CorePoints {
    /// `chosen` are the rows of the core points of each cell.
    fn new(points: &[Point], chosen: &[Cow<'_, [u32]>]) -> Self {
        let mut all = Vec::with_capacity(points.len());
        let mut begins = Vec::with_capacity(chosen.len() + 1);
        for rows in chosen {
            begins.push(all.len() as u32);
            all.extend(rows.iter().map(|&row| points[row as usize]));
        }
        begins.push(all.len() as u32);
        Self {
            points: all,
            begins,
        }
    }

    fn of(&self, cell: usize) -> &[Point] {
        &self.points[self.begins[cell] as usize..self.begins[cell + 1] as usize]
    }

    /// Whether a core point of one cell is within the radius of one of the other.
    fn touch(&self, cell: usize, other: usize, square: f32) -> bool {
        let others = self.of(other);
        let is_near = |&a: &Point| others.iter().any(|&b| square_distance(a, b) <= square);
        self.of(cell).iter().any(is_near)
    }
}

/// Of each cell the root of its set. Cells are in one set if a chain of core points, each within the
/// radius of the next, connects them.
fn connected(grid: &Cells, cores: &CorePoints, square: f32) -> Vec<u32> {
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
            for cell in (first..end).filter(|&cell| !cores.of(cell).is_empty()) {
                grid.each_near(cell, grid.column_of[cell], |near| {
                    for other in near.start.max(cell + 1)..near.end {
                        if other >= end {
                            if cores.touch(cell, other, square) {
                                across.push((cell, other));
                            }
                            continue;
                        }
                        let [a, b] = [cell, other].map(|cell| (cell - first) as u32);
                        if inside.root(a) != inside.root(b) && cores.touch(cell, other, square) {
                            inside.join(a, b);
                        }
                    }
                });
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
struct Cells {
    /// Key of each cell and the index of its first member in `rows`, sorted by key. A sentinel closes
    /// the list.
    cells: Vec<(u64, u32)>,
    rows: Vec<u32>,
    /// The points of `rows`.
    sorted: Vec<Point>,
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
    around: [Range<u32>; AROUND],
}

/// Bound on a cell's index along an axis, on each side of the origin.
const REACH: f32 = (1 << 20) as f32 - 4.0;
/// Cells along an axis that may hold points within the radius of those of the middle one.
const AROUND: usize = 5;
/// Bits of a key for each axis; the height has the lowest.
const HEIGHT: u64 = 21;

impl Cells {
    fn new(points: &[Point], side_m: f32) -> Self {
        // Points out of range belong to no cell.
        let reach_m = REACH * side_m;
        let in_reach = |&row: &u32| points[row as usize].iter().all(|c| c.abs() < reach_m);
        let rows: Vec<u32> = (0..points.len() as u32).filter(in_reach).collect();
        let keys: Vec<u64> = rows
            .iter()
            .map(|&row| key(points[row as usize], side_m))
            .collect();
        let mut table = KeyTable::<u32>::new(points.len() / EXPECTED);
        // Points that follow each other often share a cell.
        let runs = || keys.chunk_by(u64::eq);
        for run in runs() {
            *table.entry(run[0]) += run.len() as u32;
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
        let mut in_cells = vec![0; rows.len()];
        let mut left = &rows[..];
        for run in runs() {
            let (of_run, others) = left.split_at(run.len());
            let place = table.entry(run[0]);
            in_cells[*place as usize..][..run.len()].copy_from_slice(of_run);
            *place += run.len() as u32;
            left = others;
        }
        let (columns, column_of) = columns(&cells[..cells.len() - 1]);
        Self {
            cells,
            sorted: in_cells.iter().map(|&row| points[row as usize]).collect(),
            rows: in_cells,
            columns,
            column_of,
        }
    }

    /// Number of cells.
    fn len(&self) -> usize {
        self.cells.len() - 1
    }

    fn members(&self, cell: usize) -> &[u32] {
        &self.rows[self.places(&(cell..cell + 1))]
    }

    /// The places of the members of some cells in `rows`.
    fn places(&self, cells: &Range<usize>) -> Range<usize> {
        self.cells[cells.start].1 as usize..self.cells[cells.end].1 as usize
    }

    /// Calls `see` with the cells that may hold points within the radius of this cell's points, this
    /// cell included: ranges in ascending order, one for each column from `first` on that has some.
    fn each_near(&self, cell: usize, first: u32, mut see: impl FnMut(Range<usize>)) {
        let height = |key: u64| key & ((1 << HEIGHT) - 1);
        let z = height(self.cells[cell].0);
        for range in &self.columns[self.column_of[cell] as usize].around {
            for column in range.start.max(first)..range.end {
                let Range { start, end } = self.columns[column as usize].cells;
                let cells = &self.cells[start as usize..end as usize];
                let low = cells.partition_point(|&(key, _)| height(key) + 2 < z);
                let near = cells[low..].iter();
                let count = near.take_while(|&&(key, _)| height(key) <= z + 2).count();
                if count > 0 {
                    let low = start as usize + low;
                    see(low..low + count);
                }
            }
        }
    }

    /// The core points among a cell's members: those with `least` points within the radius.
    fn cores(&self, cell: usize, square: f32, least: usize) -> Vec<u32> {
        let mut near = [const { 0..0 }; AROUND * AROUND];
        let mut columns = near.iter_mut();
        self.each_near(cell, 0, |cells| {
            if let Some(places) = columns.next() {
                *places = self.places(&cells);
            }
        });
        let is_core = |place: &usize| {
            let position = self.sorted[*place];
            let mut left = least;
            for places in &near {
                for &other in &self.sorted[places.clone()] {
                    left -= usize::from(square_distance(position, other) <= square);
                    if left == 0 {
                        return true;
                    }
                }
            }
            false
        };
        let places = self.places(&(cell..cell + 1)).filter(is_core);
        places.map(|place| self.rows[place]).collect()
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

fn key([x, y, z]: Point, side_m: f32) -> u64 {
    let [x, y, z] = floors([x / side_m, y / side_m, z / side_m], [-REACH, REACH]);
    let at = |floor: i32| u64::from((floor + REACH as i32 + 4).cast_unsigned());
    at(x) << (2 * HEIGHT) | at(y) << HEIGHT | at(z)
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
mod tests;
