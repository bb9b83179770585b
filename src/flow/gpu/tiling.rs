//! Division of a submission's points into tiles for the network, chunks for the gradients (see
//! field/reduction.rs), and waves that fit into memory. Tiles and chunks depend only on the batch's
//! size, so that a result does not depend on the memory or on other pairs of the submission, to the
//! bit.

use super::layout::{Chunk, TILE, Tile};
use super::memory::LEAST_ROWS;
use crate::flow::field::{Chunks, MOST_POINTS, STRETCH};

/// A chunk is a whole number of tiles and fits into the minimum number of rows.
const _: () = assert!(STRETCH.is_multiple_of(TILE) && MOST_POINTS <= LEAST_ROWS as usize);

/// Number of tiles, and chunks, of a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Cut {
    pub(super) tiles: usize,
    pub(super) chunks: Chunks,
}

impl Cut {
    /// Divides a batch of at most `points` points.
    pub(super) fn new(points: usize) -> Self {
        Self {
            tiles: points.div_ceil(TILE).max(1),
            chunks: Chunks::new(points),
        }
    }

    /// The same in one chunk of any size, for a model whose gradients are not summed by chunk.
    pub(super) fn one(points: usize) -> Self {
        Self {
            chunks: Chunks::one(points),
            ..Self::new(points)
        }
    }

    /// The tiles of a chunk.
    fn tiles_of(&self, chunk: usize) -> core::ops::Range<usize> {
        let points = self.chunks.points(chunk);
        points.start / TILE..(points.end / TILE).min(self.tiles)
    }
}

/// A wave: tiles and chunks that are processed at the same time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Wave {
    pub(super) first_tile: usize,
    /// Row of the first tile; zero unless the wave is a piece of another.
    pub(super) first_row: usize,
    pub(super) tiles: usize,
    pub(super) first_chunk: usize,
    pub(super) chunks: usize,
}

/// The tiles and chunks of all lanes, and their waves.
#[derive(Debug, Default)]
pub(super) struct Plan {
    pub(super) tiles: Vec<Tile>,
    pub(super) chunks: Vec<Chunk>,
    pub(super) waves: Vec<Wave>,
}

impl Plan {
    /// Plans lanes with these divisions, where memory holds `rows` rows.
    pub(super) fn new(cuts: &[Cut], rows: usize) -> Self {
        let mut plan = Self::default();
        let mut wave = Wave::default();
        for (lane, cut) in (0..).zip(cuts) {
            for chunk in 0..cut.chunks.count {
                let tiles = cut.tiles_of(chunk);
                if (wave.tiles + tiles.len()) * TILE > rows && wave.tiles > 0 {
                    plan.waves.push(wave);
                    wave = Wave {
                        first_tile: plan.tiles.len(),
                        first_chunk: plan.chunks.len(),
                        ..Wave::default()
                    };
                }
                plan.chunks.push(Chunk {
                    lane,
                    first_row: (wave.tiles * TILE) as u32,
                    rows: (tiles.len() * TILE) as u32,
                    first_point: (tiles.start * TILE) as u32,
                });
                wave.tiles += tiles.len();
                wave.chunks += 1;
                let tile = |tile: usize| Tile {
                    lane,
                    tile: tile as u32,
                };
                plan.tiles.extend(tiles.map(tile));
            }
        }
        plan.waves.push(wave);
        plan
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_tile_is_in_one_wave_and_one_chunk_whatever_the_size() {
        for points in [1, 63, 64, 65, 2048, 8192, 90_000, 150_000, 2_000_000] {
            for rows in [8192, 16_384, 1 << 19] {
                let cut = Cut::new(points);
                let plan = Plan::new(&[cut, Cut::new(100)], rows);
                assert_eq!(plan.tiles.len(), cut.tiles + 2);
                assert_eq!(plan.chunks.len(), cut.chunks.count + 1);
                let (mut tile, mut chunk) = (0, 0);
                for wave in &plan.waves {
                    assert_eq!([wave.first_tile, wave.first_chunk], [tile, chunk]);
                    assert!(wave.tiles * TILE <= rows, "{points} {rows}: {wave:?}");
                    let own = &plan.chunks[chunk..chunk + wave.chunks];
                    let rows: u32 = own.iter().map(|chunk| chunk.rows).sum();
                    assert_eq!(rows as usize, wave.tiles * TILE);
                    tile += wave.tiles;
                    chunk += wave.chunks;
                }
                assert_eq!([tile, chunk], [plan.tiles.len(), plan.chunks.len()]);
            }
        }
    }

    #[test]
    fn a_chunk_begins_where_its_rows_begin() {
        let plan = Plan::new(&[Cut::new(8192), Cut::new(3000)], 1 << 19);
        assert_eq!(plan.waves.len(), 1);
        for chunk in &plan.chunks {
            let tile = plan.tiles[chunk.first_row as usize / TILE];
            assert_eq!(tile.lane, chunk.lane);
            assert_eq!(tile.tile as usize * TILE, chunk.first_point as usize);
        }
    }
}
