//! DBSCAN clustering (Ester et al. 1996) on a grid.
//!
//! The diagonal of a cell is the radius, so that all points of a cell lie within the radius of each
//! other. A cell with enough points holds core points only, without a distance computation.

use rayon::prelude::*;

use super::voxel::voxel_first;
use crate::flow::data::{Point, floor, square_distance};

/// Number of core points in a cell above which they are voxel-downsampled. The voxel side is the
/// radius over `VOXELS`.
const FULL: usize = 64;
const VOXELS: f32 = 16.0;

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
    let core: Vec<Vec<bool>> = (0..grid.cells.len())
        .into_par_iter()
        .map(|cell| grid.cores(cell, square, least))
        .collect();
    let cores: Vec<Vec<u32>> = (0..grid.cells.len())
        .into_par_iter()
        .map(|cell| {
            let members = grid.members(cell).iter().zip(&core[cell]);
            let cores = members.filter(|&(_, &is_core)| is_core);
            few(points, cores.map(|(&row, _)| row).collect(), radius_m)
        })
        .collect();
    let distance = |a: u32, b: u32| square_distance(points[a as usize], points[b as usize]);
    // Pairs of cells with core points within the radius. The relation is symmetric, so later cells
    // suffice.
    let touching: Vec<Vec<usize>> = (0..grid.cells.len())
        .into_par_iter()
        .map(|cell| {
            if cores[cell].is_empty() {
                return Vec::new();
            }
            let touches =
                |&a: &u32, other: usize| cores[other].iter().any(|&b| distance(a, b) <= square);
            let later = grid.within(cell).into_iter().filter(|&other| other > cell);
            later
                .filter(|&other| cores[cell].iter().any(|a| touches(a, other)))
                .collect()
        })
        .collect();
    let mut sets = Sets::new(grid.cells.len());
    for (cell, others) in touching.iter().enumerate() {
        for &other in others {
            sets.join(cell as u32, other as u32);
        }
    }
    // A core point takes the set of its cell, any other point that of the nearest core point.
    let root: Vec<u32> = (0..grid.cells.len() as u32)
        .map(|cell| sets.root(cell))
        .collect();
    let beside = |cell: usize, row: u32| {
        let mut best = (f32::INFINITY, NOISE);
        for other in grid.within(cell) {
            for &core in &cores[other] {
                let far = distance(row, core);
                if far <= square && far < best.0 {
                    best = (far, root[other]);
                }
            }
        }
        best.1
    };
    let found: Vec<Vec<(u32, u32)>> = (0..grid.cells.len())
        .into_par_iter()
        .map(|cell| {
            let members = grid.members(cell).iter().zip(&core[cell]);
            members
                .map(|(&row, &is_core)| {
                    let root = if is_core {
                        root[cell]
                    } else {
                        beside(cell, row)
                    };
                    (row, root)
                })
                .collect()
        })
        .collect();
    let mut labels = vec![NOISE; points.len()];
    for (row, root) in found.into_iter().flatten() {
        labels[row as usize] = root;
    }
    renumber(&mut labels, grid.cells.len());
    labels
}

/// The rows or, where they are many, one row for each small voxel, which bounds the time to compare
/// two full cells. Cells that touch by less than a voxel may then stay separate.
fn few(points: &[Point], rows: Vec<u32>, radius_m: f32) -> Vec<u32> {
    if rows.len() <= FULL {
        return rows;
    }
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
    /// Key of each cell and the index of its first member in `rows`, sorted by key.
    cells: Vec<(u64, u32)>,
    rows: Vec<u32>,
    /// Key of each column (a cell's key without the height) and the index of its first cell. A
    /// sentinel closes the list.
    columns: Vec<(u64, u32)>,
}

/// Bound on a cell's index along an axis, on each side of the origin.
const REACH: f32 = (1 << 20) as f32 - 4.0;
/// Bits of a key for each axis; the height has the lowest.
const HEIGHT: u64 = 21;

impl<'a> Cells<'a> {
    fn new(points: &'a [Point], side_m: f32) -> Self {
        let mut keyed: Vec<(u64, u32)> = points
            .iter()
            .zip(0..)
            // Points out of range belong to no cell.
            .filter(|(point, _)| point.iter().all(|c| (c / side_m).abs() < REACH))
            .map(|(&point, row)| (key(point, side_m), row))
            .collect();
        keyed.par_sort_unstable();
        let mut cells: Vec<(u64, u32)> = Vec::new();
        let mut columns: Vec<(u64, u32)> = Vec::new();
        for (&(key, _), begin) in keyed.iter().zip(0..) {
            if cells.last().is_none_or(|&(last, _)| last != key) {
                let column = key >> HEIGHT;
                if columns.last().is_none_or(|&(last, _)| last != column) {
                    columns.push((column, cells.len() as u32));
                }
                cells.push((key, begin));
            }
        }
        columns.push((u64::MAX, cells.len() as u32));
        Self {
            points,
            cells,
            rows: keyed.into_iter().map(|(_, row)| row).collect(),
            columns,
        }
    }

    fn members(&self, cell: usize) -> &[u32] {
        let end = self
            .cells
            .get(cell + 1)
            .map_or(self.rows.len(), |&(_, begin)| begin as usize);
        &self.rows[self.cells[cell].1 as usize..end]
    }

    /// The cells that may hold points within the radius of this cell's points, this cell included.
    fn within(&self, cell: usize) -> Vec<usize> {
        let key = self.cells[cell].0;
        let (column, z) = (key >> HEIGHT, key & ((1 << HEIGHT) - 1));
        let mut found = Vec::with_capacity(32);
        for dx in [-2_i64, -1, 0, 1, 2] {
            let row = column.wrapping_add_signed((dx << HEIGHT) - 2);
            let mut at = self.columns.partition_point(|&(other, _)| other < row);
            while let Some(&(other, begin)) = self.columns.get(at)
                && other <= row + 4
            {
                let end = self.columns[at + 1].1;
                let begin = begin as usize;
                let cells = &self.cells[begin..end as usize];
                let height = |key: u64| key & ((1 << HEIGHT) - 1);
                let low = cells.partition_point(|&(key, _)| height(key) + 2 < z);
                let near = cells[low..].iter();
                let near = near.take_while(|&&(key, _)| height(key) <= z + 2).count();
                found.extend(begin + low..begin + low + near);
                at += 1;
            }
        }
        found
    }

    /// Which of a cell's members are core points: those with `least` points within the radius.
    fn cores(&self, cell: usize, square: f32, least: usize) -> Vec<bool> {
        let members = self.members(cell);
        if members.len() >= least {
            return vec![true; members.len()];
        }
        let within = self.within(cell);
        let is_core = |&row: &u32| {
            let near = within.iter().flat_map(|&other| self.members(other));
            near.filter(|&&other| {
                square_distance(self.points[row as usize], self.points[other as usize]) <= square
            })
            .take(least)
            .count()
                >= least
        };
        members.iter().map(is_core).collect()
    }
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
