//! Fills the active bricks with exact distances: a banded, separable gather.
//!
//! Along z each occupied column is transformed once; a brick then takes the minimum over columns
//! in y and over rows in x, 64 values at a time in 16-bit integers. No distance is approximated
//! and no two bricks write the same value, so threads cannot change the result.

use core::cmp::Ordering;

use rayon::prelude::*;

use super::activate::{ABSENT, EDGE, Index, VOLUME};
use super::bricks::BEYOND;
use super::exact_points::NearPoints;
use super::grid::Grid;
use crate::flow::Point;

/// Farther than any sum of squares within the band; sums with it stay within 16 bits.
const FAR: i16 = 0x3FFF;

/// Codes that one cell of distance is divided into: the band's radius takes nearly all 16 bits.
pub(crate) fn codes_per_cell(band: i32) -> f64 {
    f64::from(BEYOND - 1) / f64::from(band)
}

/// A target point in cells, and the vertex that it is nearest to.
pub(crate) type Site = ([u32; 3], [f32; 3]);

/// The target's points in the order of their vertices.
pub(crate) fn sorted_points(grid: &Grid, target: &[Point]) -> Vec<Site> {
    let site = |&p: &Point| (grid.nearest_vertex(p), grid.in_cells(p).map(|c| c as f32));
    let mut sites: Vec<_> = target.iter().map(site).collect();
    sites.sort_unstable_by(|a, b| {
        a.0.cmp(&b.0)
            .then_with(|| a.1.partial_cmp(&b.1).unwrap_or(Ordering::Equal))
    });
    sites
}

/// The codes of all active bricks, 512 a brick: the distance from each vertex to the nearest of
/// `cells` (sorted, unique), or of `points` where they are given, or [`BEYOND`] where that is more
/// than `band` cells.
pub(crate) fn band_codes(
    cells: &[[u32; 3]],
    points: Option<&[Site]>,
    index: &Index,
    band: i32,
) -> Vec<u16> {
    let columns = Columns::transform(cells, points, band);
    let per_cell = codes_per_cell(band);
    let codes_of_squares: Vec<u16> = (0..=band * band)
        .map(|square| (f64::from(square).sqrt() * per_cell).round() as u16)
        .collect();

    let mut codes = vec![0u16; index.active * VOLUME];
    let mut rest = codes.as_mut_slice();
    let mut blocks = Vec::new();
    for (block, table) in block_order(index) {
        let bricks = &index.bricks[table * VOLUME..(table + 1) * VOLUME];
        let active = bricks.iter().filter(|&&b| b != ABSENT).count();
        let (own, others) = rest.split_at_mut(active * VOLUME);
        rest = others;
        blocks.push((block, bricks, own));
    }
    blocks
        .into_par_iter()
        .for_each_init(Gather::default, |gather, (block, bricks, own)| {
            gather.fill_block(&columns, block, bricks, band, &codes_of_squares, own);
        });
    codes
}

/// Blocks that have a table, in the order of their tables, with their coordinates.
fn block_order(index: &Index) -> Vec<([u32; 3], usize)> {
    let [_, ny, nz] = index.blocks;
    let mut order: Vec<_> = index
        .tables
        .iter()
        .enumerate()
        .filter(|&(_, &table)| table != ABSENT)
        .map(|(block, &table)| {
            let at = [block / (ny * nz), block / nz % ny, block % nz].map(|c| c as u32);
            (at, table as usize)
        })
        .collect();
    order.sort_unstable_by_key(|&(_, table)| table);
    order
}

/// Occupied columns (x, y), sorted, each with its squared distances along z.
struct Columns {
    /// First column of each row x, one past the last at the end.
    rows: Vec<u32>,
    y: Vec<i32>,
    /// The brick layer at which a column's distances begin, and its place in `squares`.
    layers: Vec<(u32, u32)>,
    /// Eight squared distances a layer, [`FAR`] beyond the band.
    squares: Vec<[i16; 8]>,
    /// All points in cells, sorted by column, and where each column's begin; empty unless
    /// distances are measured to points.
    points: Vec<[f32; 3]>,
    point_starts: Vec<u32>,
}

impl Columns {
    fn transform(cells: &[[u32; 3]], points: Option<&[Site]>, band: i32) -> Self {
        let last_row = cells.last().map_or(0, |cell| cell[0] as usize);
        let mut columns = Self {
            rows: vec![0; last_row + 2],
            y: vec![],
            layers: vec![],
            squares: vec![],
            points: vec![],
            point_starts: vec![],
        };
        for column in points.unwrap_or(&[]).chunk_by(|a, b| a.0[..2] == b.0[..2]) {
            columns.point_starts.push(columns.points.len() as u32);
            columns.points.extend(column.iter().map(|site| site.1));
        }
        columns.point_starts.push(columns.points.len() as u32);
        for column in cells.chunk_by(|a, b| a[..2] == b[..2]) {
            columns.rows[column[0][0] as usize + 1] += 1;
            columns.y.push(column[0][1] as i32);
            columns.push_squares(column, band);
        }
        for row in 1..columns.rows.len() {
            columns.rows[row] += columns.rows[row - 1];
        }
        columns
    }

    fn push_squares(&mut self, column: &[[u32; 3]], band: i32) {
        let reach = band as u32;
        let first = column[0][2].saturating_sub(reach) / EDGE;
        let last = (column[column.len() - 1][2] + reach) / EDGE;
        self.layers.push((first, self.squares.len() as u32));
        let mut above = 0;
        for layer in first..=last {
            self.squares.push(core::array::from_fn(|lane| {
                let z = (layer * EDGE) as i32 + lane as i32;
                while above < column.len() && (column[above][2] as i32) < z {
                    above += 1;
                }
                let up = column.get(above).map(|c| c[2] as i32 - z);
                let down = above
                    .checked_sub(1)
                    .map(|below| z - column[below][2] as i32);
                let nearest = up.into_iter().chain(down).min().unwrap_or(band + 1);
                if nearest <= band {
                    (nearest * nearest) as i16
                } else {
                    FAR
                }
            }));
        }
    }

    /// The column's squared distances in brick layer `layer`, if it reaches there.
    fn at(&self, column: usize, layer: u32) -> Option<&[i16; 8]> {
        let (first, start) = self.layers[column];
        let end = self
            .layers
            .get(column + 1)
            .map_or(self.squares.len(), |next| next.1 as usize);
        let place = start as usize + layer.checked_sub(first)? as usize;
        if place < end {
            self.squares.get(place)
        } else {
            None
        }
    }
}

/// One thread's working set.
#[derive(Default)]
struct Gather {
    /// Rows of the window around a stack of bricks: x and the range of columns.
    window: Vec<(i32, core::ops::Range<usize>)>,
    near: NearPoints,
}

impl Gather {
    /// Fills the active bricks of one block, in the order of `bricks`.
    fn fill_block(
        &mut self,
        columns: &Columns,
        block: [u32; 3],
        bricks: &[u32],
        band: i32,
        codes_of_squares: &[u16],
        own: &mut [u16],
    ) {
        let mut own = own.chunks_exact_mut(VOLUME);
        for (stack, bricks) in bricks.chunks_exact(EDGE as usize).enumerate() {
            if bricks.iter().all(|&b| b == ABSENT) {
                continue;
            }
            let brick_x = block[0] * EDGE + stack as u32 / EDGE;
            let brick_y = block[1] * EDGE + stack as u32 % EDGE;
            let (x, y) = ((brick_x * EDGE) as i32, (brick_y * EDGE) as i32);
            self.open_window(columns, x, y, band);
            for layer in (0..EDGE).filter(|&z| bricks[z as usize] != ABSENT) {
                let Some(codes) = own.next() else { return };
                if !columns.points.is_empty() {
                    let first = [x, y, ((block[2] * EDGE + layer) * EDGE) as i32].map(|c| c as f32);
                    let runs = self.window.iter().map(|(_, range)| {
                        let [start, end] =
                            [range.start, range.end].map(|c| columns.point_starts[c] as usize);
                        &columns.points[start..end]
                    });
                    self.near.collect(runs, first, band as f32 + 0.5);
                    let per_cell = codes_per_cell(band) as f32;
                    for (code, square) in codes.iter_mut().zip(self.near.squares()) {
                        let distance = square.sqrt() * per_cell;
                        *code = if distance < f32::from(BEYOND) {
                            distance.round() as u16
                        } else {
                            BEYOND
                        };
                    }
                    continue;
                }
                let squares = self.gather(columns, x, y, block[2] * EDGE + layer, band);
                for (code, square) in codes.iter_mut().zip(squares.as_flattened()) {
                    *code = codes_of_squares
                        .get(*square as usize)
                        .copied()
                        .unwrap_or(BEYOND);
                }
            }
        }
    }

    /// Finds the columns within the band of the stack of bricks at (x, y).
    fn open_window(&mut self, columns: &Columns, x: i32, y: i32, band: i32) {
        self.window.clear();
        let last_row = columns.rows.len() as i32 - 2;
        for row in (x - band).max(0)..=(x + EDGE as i32 - 1 + band).min(last_row) {
            let start = columns.rows[row as usize] as usize;
            let all = &columns.y[start..columns.rows[row as usize + 1] as usize];
            let low = all.partition_point(|&c| c < y - band);
            let count = all[low..].partition_point(|&c| c < y + EDGE as i32 + band);
            if count > 0 {
                self.window.push((row, start + low..start + low + count));
            }
        }
    }

    /// Squared distances of the brick at (x, y) in `layer`: `[x][8 y + z]`.
    fn gather(&self, columns: &Columns, x: i32, y: i32, layer: u32, band: i32) -> [[i16; 64]; 8] {
        let mut squares = [[FAR; 64]; 8];
        for (row, range) in &self.window {
            let mut along_y = [FAR; 64];
            let mut any = false;
            for column in range.clone() {
                let Some(along_z) = columns.at(column, layer) else {
                    continue;
                };
                any = true;
                for (lane, out) in along_y.as_chunks_mut::<8>().0.iter_mut().enumerate() {
                    let gap = y + lane as i32 - columns.y[column];
                    let gap = (gap * gap) as i16;
                    for (out, &z) in out.iter_mut().zip(along_z) {
                        *out = (*out).min(z + gap);
                    }
                }
            }
            if !any {
                continue;
            }
            for (lane, out) in squares.iter_mut().enumerate() {
                let gap = x + lane as i32 - row;
                if gap.abs() > band {
                    continue;
                }
                let gap = (gap * gap) as i16;
                for (out, &yz) in out.iter_mut().zip(&along_y) {
                    *out = (*out).min(yz + gap);
                }
            }
        }
        squares
    }
}
