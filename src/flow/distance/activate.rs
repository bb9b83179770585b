//! Which bricks the band touches, and where each one is kept.
//!
//! A two-level index: blocks of 8x8x8 bricks over the whole grid, tables only where a block holds
//! an active brick. Its size follows the surface, not the volume.

use super::grid::Grid;
use super::options::DistanceError;
use crate::flow::watch::{self, Watch};

/// Vertices along a brick's edge, and bricks along a block's.
pub(crate) const EDGE: u32 = 8;
/// Vertices of a brick, and bricks of a block.
pub(crate) const VOLUME: usize = 512;
/// Marks a block without a table and a brick that is not active.
pub(crate) const ABSENT: u32 = u32::MAX;
/// Bytes of a brick's 16-bit codes.
pub(crate) const BRICK_BYTES: usize = VOLUME * size_of::<u16>();
/// The most blocks: 64 MB of index.
const MAX_BLOCKS: usize = 16 << 20;
/// Occupied vertices between two looks at the watch: a few milliseconds.
const CELLS_AT_ONCE: usize = 4096;

/// Where each active brick is kept.
#[derive(Debug)]
pub(crate) struct Index {
    /// Blocks along each axis.
    pub(crate) blocks: [usize; 3],
    /// Each block's table, or [`ABSENT`].
    pub(crate) tables: Vec<u32>,
    /// 512 entries a table: the brick's number, or [`ABSENT`]. Numbers rise along this list.
    pub(crate) bricks: Vec<u32>,
    /// Active bricks.
    pub(crate) active: usize,
}

impl Index {
    /// Marks every brick that has a vertex within `band` cells of an occupied vertex.
    ///
    /// # Errors
    /// Where the grid has too many blocks, index and bricks would take more than `max_bytes`, or the
    /// watch interrupts.
    pub(crate) fn activate(
        grid: &Grid,
        cells: &[[u32; 3]],
        band: i32,
        max_bytes: usize,
        watch: &dyn Watch,
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
        let mut index = Self {
            blocks,
            tables: vec![ABSENT; total],
            bricks: Vec::new(),
            active: 0,
        };
        let reach = (band + EDGE as i32 - 1) / EDGE as i32;
        let limit = band * band;
        // Bricks are numbered by 32 bits.
        let limit_bytes = max_bytes.min(ABSENT as usize * BRICK_BYTES);
        for (number, cell) in cells.iter().enumerate() {
            if number % CELLS_AT_ONCE == 0 {
                watch::check(watch)?;
            }
            let needed = index.bytes() + index.active * BRICK_BYTES;
            if needed > limit_bytes {
                return Err(DistanceError::Memory {
                    needed,
                    limit: limit_bytes,
                });
            }
            let brick = cell.map(|c| (c / EDGE) as i32);
            let gaps: [_; 3] = core::array::from_fn(|a| (cell[a] % EDGE) as i32);
            // Squared gap along one axis between the cell and the brick `offset` away.
            let gap = |axis: usize, offset: i32| {
                let low = offset * EDGE as i32 - gaps[axis];
                let high = low + EDGE as i32 - 1;
                let gap = low.max(-high).max(0);
                gap * gap
            };
            let range = |axis: usize| {
                let last = brick_counts[axis] as i32 - 1;
                (brick[axis] - reach).max(0)..=(brick[axis] + reach).min(last)
            };
            for x in range(0) {
                let along_x = gap(0, x - brick[0]);
                for y in range(1) {
                    let along_xy = along_x + gap(1, y - brick[1]);
                    if along_xy > limit {
                        continue;
                    }
                    for z in range(2) {
                        if along_xy + gap(2, z - brick[2]) <= limit {
                            index.mark([x as u32, y as u32, z as u32]);
                        }
                    }
                }
            }
        }
        let active = index.bricks.iter_mut().filter(|brick| **brick != ABSENT);
        for (number, brick) in (0..).zip(active) {
            *brick = number;
        }
        Ok(index)
    }

    fn mark(&mut self, brick: [u32; 3]) {
        let [bx, by, bz] = brick.map(|b| (b / EDGE) as usize);
        let block = (bx * self.blocks[1] + by) * self.blocks[2] + bz;
        if self.tables[block] == ABSENT {
            self.tables[block] = (self.bricks.len() / VOLUME) as u32;
            self.bricks.resize(self.bricks.len() + VOLUME, ABSENT);
        }
        let brick = &mut self.bricks[self.tables[block] as usize * VOLUME + within(brick)];
        self.active += usize::from(*brick == ABSENT);
        *brick = 0;
    }

    /// The number of the brick that holds `vertex`, or [`ABSENT`].
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

    pub(crate) fn bytes(&self) -> usize {
        (self.tables.len() + self.bricks.len()) * size_of::<u32>()
    }
}

/// The place of a vertex in its brick, or of a brick in its block.
#[inline]
pub(crate) fn within(at: [u32; 3]) -> usize {
    let [x, y, z] = at.map(|c| (c % EDGE) as usize);
    (x * 8 + y) * 8 + z
}
