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

/// The transform: distances at the vertices of the active bricks, and a far field.
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
    /// Transforms `target` over a grid that covers both clouds, metres. Checks `control` between
    /// parts of a few milliseconds.
    ///
    /// # Errors
    /// [`DistanceError`] if the options are out of range, the target is empty, the clouds span too
    /// much space, the transform would take more than `options.max_bytes`, or `control` interrupts.
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

    /// Trilinear distance and gradient at `point`, see [`Sample`].
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

    /// The grid's geometry.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// 512 codes per active brick.
    #[cfg(all(test, feature = "gpu"))]
    pub(crate) fn codes(&self) -> &[u16] {
        &self.codes
    }

    /// Number of active bricks.
    pub fn active_bricks(&self) -> usize {
        self.index.active
    }

    /// Bytes that the transform occupies.
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
