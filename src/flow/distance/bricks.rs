//! Exact Euclidean distance transform in a narrow band, on bricks of 8x8x8 vertices.
//!
//! Most of space is empty, so only the bricks within the band of a target point are stored, as
//! 16-bit distances. Beyond the band, a coarse far field keeps the gradient toward the target. The
//! result has the same bits for any number of threads. FNSF Section 3.2, eq. 4 and 5.

use super::brick_index::{ABSENT, Index, VOLUME, within};
use super::coarse_field::CoarseField;
use super::fill;
use super::fill::BEYOND;
use super::grid::{Grid, Lattice, trilinear};
use super::options::{DistanceError, DistanceOptions, Sites};
use super::plan::Layout;
use super::point_distance::{PointGather, PointSites};
use super::sample::Sample;
use super::vertex_distance::{VertexGather, VertexSites};
use crate::flow::data::{Control, Point};

/// Euclidean distance transform in a narrow band (FNSF Section 3.2, eq. 4 and 5).
///
/// It measures the distance to sites, see [`Sites`]. A brick is a block of 8 x 8 x 8 vertices of
/// the [`Grid`]. A brick is active, that is stored, if one of its vertices lies within
/// [`DistanceOptions::band_m`] of a vertex that is nearest to a target point. Within the band the
/// distance at a vertex is exact up to its rounding to 16 bits: 0.03 mm steps for a band of 2 m.
/// For [`Sites::Points`] this holds up to one cell less than the band.
///
/// Beyond the band a coarse field takes over, with a vertex every 8 cells or more. Its distances
/// are approximate and never shorter than the band. Between vertices, distances are interpolated
/// trilinearly. The result has the same bits for any number of threads.
#[derive(Debug)]
pub struct Bricks {
    grid: Grid,
    lattice: Lattice,
    /// Metres per code.
    scale: f32,
    index: Index,
    /// 512 codes per active brick: distances in units of `scale`, or [`BEYOND`].
    codes: Vec<u16>,
    far: CoarseField,
}

impl Bricks {
    /// Builds the transform of `target` (M x 3, metres) on a grid that covers `target` and `source`
    /// (N x 3, metres). `source` affects only the size of the grid. Coordinates must not be NaN:
    /// this is not checked, and the distances would be wrong. `options.metric` is ignored.
    ///
    /// Runs on the rayon pool of the calling thread. `control` is checked before each part of the
    /// work, from any of the threads: a block of 64 x 64 x 64 vertices, a slab of the coarse field,
    /// or 4,096 runs of neighboring vertices while bricks are activated.
    ///
    /// # Errors
    /// - [`DistanceError::Cell`] if `options.cell_m` is not finite or below 0.001 m.
    /// - [`DistanceError::Band`] if `options.band_m`, in cells and rounded, is not 1 to 64.
    /// - [`DistanceError::EmptyTarget`] if `target` has no points.
    /// - [`DistanceError::Extent`] if both clouds together span more than [`Grid::MAX_EXTENT_M`]
    ///   along an axis, or a coordinate is infinite.
    /// - [`DistanceError::Memory`] if more than `options.max_bytes` are needed, or the grid has
    ///   more than 2^24 blocks of 64 x 64 x 64 vertices.
    /// - [`DistanceError::Interrupted`] if `control` interrupts.
    pub fn build(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Self, DistanceError> {
        let Layout {
            grid,
            cells,
            index,
            band,
            ..
        } = Layout::plan(source, target, options, control)?;
        // Built before the bricks, so that its temporary memory is free again.
        let far = CoarseField::build(&grid, &cells, f64::from(band) * grid.cell, control)?;
        let codes = match options.sites {
            Sites::Cells => {
                let sites = VertexSites::new(&cells, band);
                fill::band_codes(&index, || VertexGather::new(&sites), control)?
            }
            Sites::Points => {
                let sites = PointSites::new(&grid, target, band);
                fill::band_codes(&index, || PointGather::new(&sites), control)?
            }
        };
        Ok(Self {
            lattice: Lattice::new(&grid),
            scale: (options.cell_m / fill::codes_per_cell(band)) as f32,
            grid,
            index,
            codes,
            far,
        })
    }

    /// The distance from `point` (x, y, z in metres) to the target, and its gradient.
    ///
    /// The distance, metres, is interpolated trilinearly between the vertices of the grid. The
    /// gradient is the derivative of that interpolation and has no unit. Outside the grid the
    /// distance is that of the nearest position on the grid's border. The gradient is then zero
    /// along each axis on which the point lies outside. A NaN coordinate gives a NaN distance.
    ///
    /// Beyond the band the distances at the vertices come from the coarse field. They are
    /// approximate, and never below [`DistanceOptions::band_m`], rounded to whole cells.
    #[inline]
    pub fn sample(&self, point: Point) -> Sample {
        let cell = self.lattice.locate(point);
        let (distance, slope) = match self.corners(cell.corner) {
            Some(corners) => trilinear(corners, cell.fraction),
            None => self.far.sample(cell.corner, cell.fraction),
        };
        Sample {
            distance,
            gradient: core::array::from_fn(|a| {
                slope[a] * self.lattice.inverse_cell * cell.inside[a]
            }),
        }
    }

    /// The grid whose vertices hold the distances.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// 512 codes per active brick.
    #[cfg(all(test, feature = "gpu"))]
    pub(crate) fn codes(&self) -> &[u16] {
        &self.codes
    }

    /// Number of stored bricks, of 512 vertices each.
    pub fn active_bricks(&self) -> usize {
        self.index.active
    }

    /// Bytes of memory that the transform occupies: the index and distances of its bricks, and the
    /// coarse field.
    pub fn bytes(&self) -> usize {
        self.index.bytes()
            + self.codes.len() * size_of::<u16>()
            + self.far.distances.len() * size_of::<f32>()
    }

    /// Distances at the cell's eight corners, metres; none if no corner is within the band.
    #[inline]
    fn corners(&self, corner: [u32; 3]) -> Option<[f32; 8]> {
        let codes = if corner.iter().all(|c| c % 8 != 7) {
            let brick = self.index.brick_of(corner);
            if brick == ABSENT {
                return None;
            }
            let start = brick as usize * VOLUME;
            let codes = &self.codes[start..start + VOLUME];
            let at = within(corner);
            [0, 1, 8, 9, 64, 65, 72, 73].map(|step| codes[at + step])
        } else {
            core::array::from_fn(|i| self.code(corner_vertex(corner, i)))
        };
        if codes.iter().all(|&code| code != BEYOND) {
            return Some(codes.map(|code| f32::from(code) * self.scale));
        }
        if codes.iter().all(|&code| code == BEYOND) {
            return None;
        }
        Some(core::array::from_fn(|i| {
            self.at_vertex(corner_vertex(corner, i))
        }))
    }

    /// Distance at a vertex, metres; from the far field beyond the band.
    pub(super) fn at_vertex(&self, vertex: [u32; 3]) -> f32 {
        match self.code(vertex) {
            BEYOND => self.far.sample(vertex, [0.0; 3]).0,
            code => f32::from(code) * self.scale,
        }
    }

    /// The vertex's distance in units of `scale`, or [`BEYOND`].
    #[inline]
    pub(super) fn code(&self, vertex: [u32; 3]) -> u16 {
        match self.index.brick_of(vertex) {
            ABSENT => BEYOND,
            brick => self.codes[brick as usize * VOLUME + within(vertex)],
        }
    }
}

/// Corner `i` of the cell at `corner`: bits 4, 2 and 1 step along x, y and z.
fn corner_vertex(corner: [u32; 3], i: usize) -> [u32; 3] {
    let i = i as u32;
    [
        corner[0] + (i >> 2),
        corner[1] + (i >> 1 & 1),
        corner[2] + (i & 1),
    ]
}
