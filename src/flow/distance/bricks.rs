//! Exact Euclidean distance transform in a narrow band, on bricks of 8x8x8 vertices.
//!
//! Space is empty almost everywhere: only bricks within the band of a target point are stored,
//! with 16-bit distances; beyond the band a coarse far field goes on, so that a lost point is still
//! pulled home. Deterministic whatever the number of threads. FNSF Section 3.2, eq. 4 and 5.

use super::brick_index::{ABSENT, Index, VOLUME, within};
use super::coarse_field::FarField;
use super::fill;
use super::fill::BEYOND;
use super::grid::{Grid, Lattice, trilinear};
use super::options::{DistanceError, DistanceOptions, Sites};
use super::plan::Layout;
use super::point_distance::{PointGather, PointSites};
use super::transform::Sample;
use super::vertex_distance::{CellGather, CellSites};
use crate::flow::data::{Control, Point, Uncontrolled};

/// The transform: distances at the vertices of active bricks, and a far field.
#[derive(Debug)]
pub struct Bricks {
    grid: Grid,
    lattice: Lattice,
    /// Metres of one code.
    scale: f32,
    index: Index,
    /// 512 codes an active brick: distance in units of `scale`, or [`BEYOND`].
    codes: Vec<u16>,
    far: FarField,
}

impl Bricks {
    /// Transforms `target` over a grid that covers both clouds.
    ///
    /// # Errors
    /// [`DistanceError`] where the options make no sense, the clouds span too much space, or the
    /// transform would take more than `options.max_bytes`.
    pub fn build(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
    ) -> Result<Self, DistanceError> {
        Self::build_watched(source, target, options, &Uncontrolled)
    }

    /// As [`Self::build`]; looks at `control` between pieces of some milliseconds.
    ///
    /// # Errors
    /// As [`Self::build`], and [`DistanceError::Interrupted`].
    pub fn build_watched(
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
        // Before the bricks, so that what it needs meanwhile is free again.
        let far = FarField::build(&grid, &cells, f64::from(band) * grid.cell, control)?;
        let codes = match options.sites {
            Sites::Cells => {
                let sites = CellSites::new(&cells, band);
                fill::band_codes(&index, || CellGather::new(&sites), control)?
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

    /// 512 codes an active brick.
    #[cfg(all(test, feature = "gpu"))]
    pub(crate) fn codes(&self) -> &[u16] {
        &self.codes
    }

    /// Active bricks.
    pub fn active_bricks(&self) -> usize {
        self.index.active
    }

    /// Bytes that the transform occupies.
    pub fn bytes(&self) -> usize {
        self.index.bytes()
            + self.codes.len() * size_of::<u16>()
            + self.far.distances.len() * size_of::<f32>()
    }

    /// Distances at the cell's eight corners; none where no corner is within the band.
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

    /// Metres at a vertex.
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
