//! The index of active bricks: which bricks the band touches, and the storage number of each.
//!
//! Two levels: blocks of 8x8x8 bricks over the whole grid, with a table only for blocks that hold
//! an active brick. Its size grows with the surface, not with the volume.

use super::grid::Grid;
use super::options::DistanceError;
use crate::flow::data::{Control, control};

/// Vertices along a brick's edge, and bricks along a block's edge.
pub(crate) const EDGE: u32 = 8;
/// Vertices per brick, and bricks per block.
pub(crate) const VOLUME: usize = 512;
/// Marks a block without a table, and an inactive brick.
pub(crate) const ABSENT: u32 = u32::MAX;
/// Bytes of a brick's 16-bit distance codes.
pub(crate) const BRICK_BYTES: usize = VOLUME * size_of::<u16>();
/// The most blocks of a grid: 64 MiB of index.
const MAX_BLOCKS: usize = 16 << 20;
/// Runs of occupied vertices between two checks of the control: a few milliseconds.
const RUNS_AT_ONCE: usize = 4096;

/// The two-level index from bricks to their storage numbers.
#[derive(Debug)]
pub(crate) struct Index {
    /// Blocks along each axis.
    pub(crate) blocks: [usize; 3],
    /// The table number of each block, or [`ABSENT`].
    pub(crate) tables: Vec<u32>,
    /// 512 entries per table: the brick's storage number, or [`ABSENT`]. The numbers ascend along
    /// this list.
    pub(crate) bricks: Vec<u32>,
    /// Number of active bricks.
    pub(crate) active: usize,
}

impl Index {
    /// Activates every brick that has a vertex within `band` cells of an occupied vertex. `cells`
    /// are the occupied vertices, sorted.
    ///
    /// # Errors
    /// If the grid has too many blocks, index and bricks would take more than `max_bytes`, or the
    /// control interrupts.
    pub(crate) fn activate(
        grid: &Grid,
        cells: &[[u32; 3]],
        band: i32,
        max_bytes: usize,
        control: &dyn Control,
    ) -> Result<Self, DistanceError> {
        let brick_counts = grid.vertices.map(|n| n.div_ceil(EDGE as usize));
        let blocks = brick_counts.map(|n| n.div_ceil(EDGE as usize));
        let total = blocks.iter().product::<usize>();
        if total > MAX_BLOCKS {
            let bytes = |blocks: usize| blocks.saturating_mul(size_of::<u32>());
            return Err(DistanceError::Memory {
                needed: bytes(total),
                limit: bytes(MAX_BLOCKS),
            });
        }
        let mut marks = Marks {
            blocks,
            tables: vec![ABSENT; total],
            columns: Vec::new(),
            active: 0,
        };
        let reach = (band + EDGE as i32 - 1) / EDGE as i32;
        let limit = band * band;
        // Half the height of the band along z, by the squared horizontal distance between an
        // occupied vertex and a column of bricks; both in cells.
        let along_z: Vec<i32> = (0..=limit).map(|gap| (limit - gap).isqrt()).collect();
        // Bricks are numbered by 32 bits.
        let limit_bytes = max_bytes.min(ABSENT as usize * BRICK_BYTES);
        // The band around a run of vertices consecutive in z spans from its lowest to its highest
        // vertex, so each run is marked once.
        let above = |a: &[u32; 3], b: &[u32; 3]| a[..2] == b[..2] && b[2] == a[2] + 1;
        for (number, run) in cells.chunk_by(above).enumerate() {
            if number % RUNS_AT_ONCE == 0 {
                control::check(control)?;
            }
            let needed = marks.index_bytes() + marks.active * BRICK_BYTES;
            if needed > limit_bytes {
                return Err(DistanceError::Memory {
                    needed,
                    limit: limit_bytes,
                });
            }
            let at = run[0].map(|c| c as i32);
            let top = run[run.len() - 1][2] as i32;
            let [bx, by, _] = at.map(|c| c / EDGE as i32);
            // Squared distance along one axis between the vertex and a brick, in cells.
            let gap = |axis: usize, brick: i32| {
                let low = brick * EDGE as i32 - at[axis];
                let high = low + EDGE as i32 - 1;
                let gap = low.max(-high).max(0);
                gap * gap
            };
            let last = brick_counts.map(|n| n as i32 - 1);
            for x in (bx - reach).max(0)..=(bx + reach).min(last[0]) {
                let along_x = gap(0, x);
                for y in (by - reach).max(0)..=(by + reach).min(last[1]) {
                    let along_xy = along_x + gap(1, y);
                    if along_xy > limit {
                        continue;
                    }
                    let up = along_z[along_xy as usize];
                    let low = (at[2] - up).max(0) / EDGE as i32;
                    let high = ((top + up) / EDGE as i32).min(last[2]);
                    marks.mark([x as u32, y as u32], low as u32, high as u32);
                }
            }
        }
        Ok(marks.numbered())
    }

    /// The storage number of the brick that holds `vertex`, or [`ABSENT`].
    #[inline]
    pub(crate) fn brick_of(&self, vertex: [u32; 3]) -> u32 {
        let brick = vertex.map(|v| v / EDGE);
        let [bx, by, bz] = brick.map(|b| (b / EDGE) as usize);
        let table = self.tables[(bx * self.blocks[1] + by) * self.blocks[2] + bz];
        if table == ABSENT {
            return ABSENT;
        }
        self.bricks[table as usize * VOLUME + within(brick)]
    }

    /// The blocks that have a table, in the order of their tables: the position in blocks, and the
    /// table number.
    pub(crate) fn tabled_blocks(&self) -> Vec<([usize; 3], usize)> {
        let [_, ny, nz] = self.blocks;
        let tables = self.tables.iter().enumerate();
        let mut order: Vec<_> = tables
            .filter(|&(_, &table)| table != ABSENT)
            .map(|(block, &table)| {
                let at = [block / (ny * nz), block / nz % ny, block % nz];
                (at, table as usize)
            })
            .collect();
        order.sort_unstable_by_key(|&(_, table)| table);
        order
    }

    /// The positions of the active bricks, in bricks, in the order of their storage numbers.
    #[cfg(feature = "gpu")]
    pub(crate) fn active_brick_positions(&self) -> Vec<[u32; 3]> {
        let mut indices = Vec::with_capacity(self.active);
        for (block, table) in self.tabled_blocks() {
            let bricks = &self.bricks[table * VOLUME..(table + 1) * VOLUME];
            let active = (0..VOLUME as u32).filter(|&at| bricks[at as usize] != ABSENT);
            indices.extend(active.map(|at| {
                let within = [at >> 6, at >> 3 & 7, at & 7];
                core::array::from_fn(|axis| block[axis] as u32 * EDGE + within[axis])
            }));
        }
        indices
    }

    pub(crate) fn bytes(&self) -> usize {
        (self.tables.len() + self.bricks.len()) * size_of::<u32>()
    }
}

/// The bricks marked so far: one bit each, eight along z per byte.
struct Marks {
    blocks: [usize; 3],
    tables: Vec<u32>,
    /// 64 columns per table, by x and y.
    columns: Vec<u8>,
    active: usize,
}

impl Marks {
    /// Columns per table.
    const COLUMNS: usize = (EDGE * EDGE) as usize;

    /// Marks the bricks from `low` to `high` along z, both included.
    fn mark(&mut self, [x, y]: [u32; 2], low: u32, high: u32) {
        let [bx, by] = [x, y].map(|b| (b / EDGE) as usize);
        let row = (bx * self.blocks[1] + by) * self.blocks[2];
        let column = (x % EDGE * EDGE + y % EDGE) as usize;
        for bz in low / EDGE..=high / EDGE {
            let table = &mut self.tables[row + bz as usize];
            if *table == ABSENT {
                *table = (self.columns.len() / Self::COLUMNS) as u32;
                self.columns.resize(self.columns.len() + Self::COLUMNS, 0);
            }
            let first = low.max(bz * EDGE) % EDGE;
            let last = high.min(bz * EDGE + EDGE - 1) % EDGE;
            let mask = (u8::MAX << first) & (u8::MAX >> (EDGE - 1 - last));
            let bits = &mut self.columns[*table as usize * Self::COLUMNS + column];
            self.active += (mask & !*bits).count_ones() as usize;
            *bits |= mask;
        }
    }

    /// Bytes of the index that these marks become.
    fn index_bytes(&self) -> usize {
        let entries = self.tables.len() + self.columns.len() * EDGE as usize;
        entries * size_of::<u32>()
    }

    /// The index, with the marked bricks numbered.
    fn numbered(self) -> Index {
        let mut numbers = 0..;
        let bits = self.columns.iter();
        let marked = bits.flat_map(|bits| (0..EDGE).map(move |z| bits >> z & 1 == 1));
        let number = |marked: bool| marked.then(|| numbers.next()).flatten();
        Index {
            blocks: self.blocks,
            tables: self.tables,
            bricks: marked.map(number).map(|n| n.unwrap_or(ABSENT)).collect(),
            active: self.active,
        }
    }
}

/// The position of a vertex in its brick, or of a brick in its block, in 0..512.
#[inline]
pub(crate) fn within(at: [u32; 3]) -> usize {
    let [x, y, z] = at.map(|c| (c % EDGE) as usize);
    (x * 8 + y) * 8 + z
}
