//! The layout of a transform on bricks and its memory, known before any distance is computed.

use super::brick_index::{BRICK_BYTES, Index};
use super::coarse_field::CoarseField;
use super::grid::Grid;
use super::options::{DistanceError, DistanceOptions, Sites};
use super::point_distance::PointSites;
use super::vertex_distance::VertexSites;
use crate::flow::data::{Control, Point};

/// The layout of a transform on bricks.
pub(crate) struct Layout {
    pub(crate) grid: Grid,
    /// Occupied vertices, sorted, without duplicates.
    pub(crate) cells: Vec<[u32; 3]>,
    pub(crate) index: Index,
    /// The band's radius in cells.
    pub(crate) band: i32,
    /// An upper bound on the bytes of the sites that the bricks are computed from.
    pub(crate) sites: usize,
}

impl Layout {
    /// Plans the transform of `target` over a grid that covers both clouds.
    ///
    /// # Errors
    /// [`DistanceError`] as [`super::Bricks::build`].
    pub(crate) fn plan(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Self, DistanceError> {
        options.check()?;
        let grid = Grid::covering(source, target, options.cell_m)?;
        let mut cells: Vec<_> = target.iter().map(|&p| grid.nearest_vertex(p)).collect();
        // One comparison of 128-bit keys is faster than three comparisons of coordinates: half of those
        // are mispredicted.
        cells.sort_unstable_by_key(|&cell| {
            let [x, y, z] = cell.map(u128::from);
            x << 64 | y << 32 | z
        });
        cells.dedup();
        let band = options.band_cells();
        let index = Index::activate(&grid, &cells, band, options.max_bytes, control)?;
        let sites = match options.sites {
            Sites::Cells => VertexSites::bytes(cells.len(), band),
            Sites::Points => PointSites::bytes(target.len()),
        };
        let bytes =
            index.bytes() + index.active * BRICK_BYTES + CoarseField::bytes_over(&grid) + sites;
        if bytes > options.max_bytes {
            return Err(DistanceError::Memory {
                needed: bytes,
                limit: options.max_bytes,
            });
        }
        Ok(Self {
            grid,
            cells,
            index,
            band,
            sites,
        })
    }
}
