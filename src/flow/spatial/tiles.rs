//! Square columns of space, found through tiles of 8 x 8 columns.
//!
//! A hash table finds a tile. One bit for each of its columns says whether the column holds points,
//! and the number of bits before it is its place among the tile's columns. Memory is therefore
//! proportional to the columns that hold points, however far apart they lie.

use std::ops::Range;

use super::key_table::KeyTable;
use crate::flow::data::{Point, floors};

/// Bound on a column's index along an axis, on each side of the origin. Points beyond it share the
/// outermost column.
const REACH: f32 = (1 << 30) as f32;
/// Binary logarithm of the columns along the side of a tile.
const SIDE_BITS: i32 = 3;
const SIDE: i32 = 1 << SIDE_BITS;
/// The columns of a tile with the same x.
const ROW: u64 = (1 << SIDE) - 1;

/// A tile that holds points.
#[derive(Clone, Copy, Debug, Default)]
struct Tile {
    /// One bit a column that holds points, x in the high bits and y in the low ones.
    occupied: u64,
    /// Index of its first column that holds points.
    first: u32,
}

/// The columns that hold points, numbered by tile and then by x and y, and the range of the points
/// of each.
#[derive(Debug)]
pub(super) struct Tiles {
    column_m: f32,
    columns_per_m: f32,
    table: KeyTable<Tile>,
    /// Index of the first point of each column, and the number of points at the end.
    begins: Vec<u32>,
}

impl Tiles {
    /// Divides `points` into columns with a side of `column_m` metres. Also returns the input rows
    /// in the order of the columns; within a column they ascend.
    pub(super) fn new(points: &[Point], column_m: f32) -> (Self, Vec<u32>) {
        let columns_per_m = 1.0 / column_m;
        let columns = points
            .iter()
            .map(|&[x, y, _]| columns_at([x, y], columns_per_m));
        let columns: Vec<[i32; 2]> = columns.collect();
        let mut table = KeyTable::<Tile>::new(0);
        // Points that follow each other often share a tile.
        for run in columns.chunk_by(|&a, &b| tile_of(a) == tile_of(b)) {
            let tile = table.entry(key(tile_of(run[0])));
            for &column in run {
                tile.occupied |= bit(column);
            }
        }
        let mut count = 0;
        for key in table.sorted() {
            let tile = table.entry(key);
            tile.first = count;
            count += tile.occupied.count_ones();
        }
        let mut last = (key([i32::MIN; 2]), Tile::default());
        let numbers = columns.iter().map(|&column| {
            let wanted = key(tile_of(column));
            if wanted != last.0 {
                last = (wanted, table.get(wanted).copied().unwrap_or_default());
            }
            last.1.first + (last.1.occupied & (bit(column) - 1)).count_ones()
        });
        let numbers: Vec<u32> = numbers.collect();
        // Counting sort.
        let mut begins = vec![0_u32; count as usize + 1];
        for &number in &numbers {
            begins[number as usize] += 1;
        }
        let mut sum = 0;
        for begin in &mut begins {
            sum += core::mem::replace(begin, sum);
        }
        let mut next = begins.clone();
        let mut rows = vec![0_u32; points.len()];
        for (&number, row) in numbers.iter().zip(0..) {
            let next = &mut next[number as usize];
            rows[*next as usize] = row;
            *next += 1;
        }
        let tiles = Self {
            column_m,
            columns_per_m,
            table,
            begins,
        };
        (tiles, rows)
    }

    /// Number of tiles that hold points.
    pub(super) fn count(&self) -> usize {
        self.table.len()
    }

    /// The tiles: indices, one bit a column that holds points, and the first of these columns.
    pub(super) fn all(&self) -> impl Iterator<Item = ([i32; 2], u64, u32)> {
        let tiles = self.table.all();
        tiles.map(|(key, tile)| (tile_at(key), tile.occupied, tile.first))
    }

    /// Index of the first point of each column, and the number of points at the end.
    pub(super) fn begins(&self) -> &[u32] {
        &self.begins
    }

    /// Side of a column, metres, and its inverse.
    pub(super) fn sides(&self) -> [f32; 2] {
        [self.column_m, self.columns_per_m]
    }

    /// Side of a column, metres.
    pub(super) fn column_m(&self) -> f32 {
        self.column_m
    }

    /// Calls `see` with ranges of points that together are all points of the columns that touch the
    /// rectangle between two corners, metres along x and y, the lower one first. The ranges ascend.
    #[inline(always)]
    pub(super) fn each_run(&self, corners: [[f32; 2]; 2], mut see: impl FnMut(Range<usize>)) {
        let [[left, low], [right, high]] = corners;
        let [left, low, right, high] = columns_at([left, low, right, high], self.columns_per_m);
        let (mut tile_x, last_x) = (left >> SIDE_BITS, right >> SIDE_BITS);
        // `while` compiles to less than `for` over an inclusive range.
        while tile_x <= last_x {
            let (x_low, x_high) = inside(left, right, tile_x);
            let (mut tile_y, last_y) = (low >> SIDE_BITS, high >> SIDE_BITS);
            while tile_y <= last_y {
                if let Some(&tile) = self.table.get(key([tile_x, tile_y])) {
                    let (y_low, y_high) = inside(low, high, tile_y);
                    let row = (ROW << y_low) & (ROW >> (SIDE.cast_unsigned() - 1 - y_high));
                    let mut place = x_low << SIDE_BITS;
                    while place <= x_high << SIDE_BITS {
                        let wanted = (tile.occupied & row << place).count_ones();
                        if wanted > 0 {
                            let before = tile.occupied & ((1 << (place + y_low)) - 1);
                            let first = (tile.first + before.count_ones()) as usize;
                            let end = self.begins[first + wanted as usize];
                            see(self.begins[first] as usize..end as usize);
                        }
                        place += SIDE.cast_unsigned();
                    }
                }
                tile_y += 1;
            }
            tile_x += 1;
        }
    }
}

/// The part of the columns from `low` to `high` that lies in a tile, counted from the tile's side.
#[inline(always)]
fn inside(low: i32, high: i32, tile: i32) -> (u32, u32) {
    let at = |column: i32, beyond: u32| {
        if column >> SIDE_BITS == tile {
            (column & (SIDE - 1)).cast_unsigned()
        } else {
            beyond
        }
    };
    (at(low, 0), at(high, SIDE.cast_unsigned() - 1))
}

/// Indices of columns along x or y at the coordinates `places`, metres. They grow with the
/// coordinates, rounding included.
#[inline(always)]
fn columns_at<const N: usize>(mut places: [f32; N], columns_per_m: f32) -> [i32; N] {
    for place in &mut places {
        *place *= columns_per_m;
    }
    floors(places, [-REACH, REACH])
}

fn tile_of(column: [i32; 2]) -> [i32; 2] {
    column.map(|index| index >> SIDE_BITS)
}

/// The bit of a column in its tile.
fn bit([x, y]: [i32; 2]) -> u64 {
    1 << ((x & (SIDE - 1)) << SIDE_BITS | y & (SIDE - 1))
}

/// The key of a tile. Keys are in the order of x and then of y.
#[inline(always)]
fn key(tile: [i32; 2]) -> u64 {
    let [x, y] = tile.map(|index| index.cast_unsigned() ^ 1 << 31);
    u64::from(x) << 32 | u64::from(y)
}

/// The tile of a key.
fn tile_at(key: u64) -> [i32; 2] {
    [(key >> 32) as u32, key as u32].map(|index| (index ^ 1 << 31).cast_signed())
}
