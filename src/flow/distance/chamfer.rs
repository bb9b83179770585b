//! The published code's distance transform: a chamfer metric on a dense grid, for comparison.
//!
//! Six raster passes. In each, a cell takes the minimum of itself and the 3x3 cells of the
//! preceding plane plus the length of the step. In closed form, per occupied vertex, with the
//! sorted offsets `a >= b >= c`: `a + (sqrt 2 - 1) b + (sqrt 3 - sqrt 2) c` cells. This is up to
//! 12.8% longer than the Euclidean distance. The transform takes 4 bytes for every vertex of the
//! grid, so it suits small grids only.

use core::f32::consts::SQRT_2;

use super::grid::{Grid, Lattice, trilinear};
use super::options::{DistanceError, DistanceOptions};
use super::sample::Sample;
use crate::flow::data::{Control, Interrupt, Point, control};

/// Length of a cell's space diagonal, in cells.
const SQRT_3: f32 = 1.732_050_8;

/// Chamfer distance transform of the published FNSF code, on a dense grid.
///
/// It holds one distance in metres for each of the nx x ny x nz vertices of its [`Grid`], 4 bytes a
/// vertex. Distances are to the nearest site; sites are the vertices nearest to the target's
/// points. With the absolute components `a >= b >= c` of the offset to a site, in cells, the
/// distance is `a + (sqrt 2 - 1) b + (sqrt 3 - sqrt 2) c` cells. This is up to 12.8% longer than
/// the Euclidean distance. Between vertices, distances are interpolated trilinearly.
#[derive(Debug)]
pub struct DenseChamfer {
    grid: Grid,
    lattice: Lattice,
    distances: Vec<f32>,
}

impl DenseChamfer {
    /// Builds the transform of `target` (M x 3, metres) on a grid that covers `target` and `source`
    /// (N x 3, metres). Coordinates must not be NaN: this is not checked, and the distances would
    /// be wrong. Only `cell_m` and `max_bytes` of `options` have an effect, but `band_m` is checked
    /// as well. Runs on the calling thread. Six raster passes cross the grid, two along each axis,
    /// and each checks `control` before every plane.
    ///
    /// # Errors
    /// - [`DistanceError::Cell`] if `options.cell_m` is not finite or below 0.001 m.
    /// - [`DistanceError::Band`] if `options.band_m`, in cells and rounded, is not 1 to 64.
    /// - [`DistanceError::EmptyTarget`] if `target` has no points.
    /// - [`DistanceError::Extent`] if both clouds together span more than [`Grid::MAX_EXTENT_M`]
    ///   along an axis, or a coordinate is infinite.
    /// - [`DistanceError::Memory`] if 4 bytes a vertex are more than `options.max_bytes` or
    ///   [`isize::MAX`].
    /// - [`DistanceError::Interrupted`] if `control` interrupts.
    pub fn build(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Self, DistanceError> {
        let grid = Self::plan(source, target, options)?;
        let [nx, ny, nz] = grid.vertices;
        let mut distances = vec![f32::INFINITY; nx * ny * nz];
        for &point in target {
            let [x, y, z] = grid.nearest_vertex(point).map(|v| v as usize);
            distances[(x * ny + y) * nz + z] = 0.0;
        }
        let strides = [ny * nz, nz, 1];
        for axis in 0..3 {
            sweep(&mut distances, grid.vertices, strides, axis, false, control)?;
            sweep(&mut distances, grid.vertices, strides, axis, true, control)?;
        }
        for distance in &mut distances {
            *distance *= grid.cell as f32;
        }
        Ok(Self {
            lattice: Lattice::new(&grid),
            grid,
            distances,
        })
    }

    /// The grid of the transform; an error if it would not fit in memory.
    pub(super) fn plan(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
    ) -> Result<Grid, DistanceError> {
        options.check()?;
        let grid = Grid::covering(source, target, options.cell_m)?;
        let bytes = grid
            .vertices
            .iter()
            .try_fold(size_of::<f32>(), |n, &v| n.checked_mul(v));
        let needed = bytes.unwrap_or(usize::MAX);
        // No allocation can exceed isize::MAX bytes, whatever `max_bytes` is.
        let limit = options.max_bytes.min(isize::MAX as usize);
        if needed > limit {
            return Err(DistanceError::Memory { needed, limit });
        }
        Ok(grid)
    }

    /// The distance from `point` (x, y, z in metres) to the target, and its gradient.
    ///
    /// The distance, metres, is interpolated trilinearly between the vertices of the grid. The
    /// gradient is the derivative of that interpolation and has no unit. Outside the grid the
    /// distance is that of the nearest position on the grid's border. The gradient is then zero
    /// along each axis on which the point lies outside. A NaN coordinate gives a NaN distance.
    #[inline]
    pub fn sample(&self, point: Point) -> Sample {
        let cell = self.lattice.locate(point);
        let corners = core::array::from_fn(|i| {
            let i = i as u32;
            let [x, y, z] = cell.corner;
            self.at([x + (i >> 2), y + (i >> 1 & 1), z + (i & 1)])
        });
        let (distance, slope) = trilinear(corners, cell.fraction);
        let inverse = self.lattice.inverse_cell;
        let gradient = core::array::from_fn(|a| slope[a] * inverse * cell.inside[a]);
        Sample { distance, gradient }
    }

    /// The grid whose vertices hold the distances.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Bytes of memory that the transform occupies: 4 for each vertex of the grid.
    pub fn bytes(&self) -> usize {
        self.distances.len() * size_of::<f32>()
    }

    pub(super) fn at(&self, vertex: [u32; 3]) -> f32 {
        let [x, y, z] = vertex.map(|v| v as usize);
        let [_, ny, nz] = self.grid.vertices;
        self.distances[(x * ny + y) * nz + z]
    }
}

/// One raster pass along `axis`: every cell takes the minimum of itself and the 3x3 cells of the
/// preceding plane, which are 1, sqrt 2 or sqrt 3 cells away.
fn sweep(
    distances: &mut [f32],
    counts: [usize; 3],
    strides: [usize; 3],
    axis: usize,
    back: bool,
    control: &dyn Control,
) -> Result<(), Interrupt> {
    // z is the inner axis wherever possible: cells adjacent in memory are then adjacent in the
    // plane.
    let (a, b) = [(1, 2), (0, 2), (0, 1)][axis];
    let planes = Planes {
        rows: counts[a],
        columns: counts[b],
        row_stride: strides[a],
        column_stride: strides[b],
    };
    let mut before = planes.empty();
    let mut current = planes.empty();
    for step in 0..counts[axis] {
        control::check(control)?;
        let plane = if back { counts[axis] - 1 - step } else { step };
        planes.lower(
            &mut distances[plane * strides[axis]..],
            &before,
            &mut current,
        );
        core::mem::swap(&mut before, &mut current);
    }
    Ok(())
}

/// The planes across a raster pass: their size and memory layout.
struct Planes {
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl Planes {
    /// A buffer for one plane with a border of one cell, all at infinite distance.
    fn empty(&self) -> Vec<f32> {
        vec![f32::INFINITY; (self.rows + 2) * (self.columns + 2)]
    }

    /// Lowers the cells of one plane by the plane `before`, and copies them to `current`.
    fn lower(&self, cells: &mut [f32], before: &[f32], current: &mut [f32]) {
        let width = self.columns + 2;
        let rows = current.chunks_exact_mut(width).skip(1).take(self.rows);
        for (row, current) in rows.enumerate() {
            let near: [&[f32]; 3] =
                core::array::from_fn(|i| &before[(row + i) * width..(row + i + 1) * width]);
            let own = row * self.row_stride;
            let current = &mut current[1..=self.columns];
            for (column, current) in current.iter_mut().enumerate() {
                *current = cells[own + column * self.column_stride];
            }
            lower_row(current, near);
            for (column, current) in current.iter().enumerate() {
                cells[own + column * self.column_stride] = *current;
            }
        }
    }
}

/// Lowers a row by the three rows of the preceding plane, which have one more cell at both ends.
fn lower_row(row: &mut [f32], near: [&[f32]; 3]) {
    let lower = |a: f32, b: f32| if b < a { b } else { a };
    let [above, middle, below] = near.map(|row| row.windows(3));
    for (own, ((above, middle), below)) in row.iter_mut().zip(above.zip(middle).zip(below)) {
        let straight = middle[1] + 1.0;
        let edge = lower(lower(above[1], below[1]), lower(middle[0], middle[2])) + SQRT_2;
        let corner = lower(lower(above[0], above[2]), lower(below[0], below[2])) + SQRT_3;
        *own = lower(*own, lower(straight, lower(edge, corner)));
    }
}
