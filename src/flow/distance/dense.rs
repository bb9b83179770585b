//! The published code's transform: a chamfer path metric on a dense grid, for comparison.
//!
//! Six raster sweeps, each cell taking the least of the 3x3 cells of the plane before it plus the
//! step's length. In closed form, per occupied vertex, with `a >= b >= c` the sorted offsets:
//! `a + (sqrt 2 - 1) b + (sqrt 3 - sqrt 2) c` cells: up to 12.8% longer than the Euclidean
//! distance. Takes 4 bytes for every cell of the scene, so it is for small grids.

use super::Sample;
use super::grid::{Grid, trilinear};
use super::options::{DistanceError, DistanceOptions};
use crate::flow::Point;

/// The transform: metres at every vertex of the grid.
#[derive(Debug)]
pub struct DenseChamfer {
    grid: Grid,
    distances: Vec<f32>,
}

impl DenseChamfer {
    /// Transforms `target` over a grid that covers both clouds.
    ///
    /// # Errors
    /// [`DistanceError`] as [`super::Bricks::build`].
    pub fn build(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
    ) -> Result<Self, DistanceError> {
        options.check()?;
        let grid = Grid::covering(source, target, options.cell_m)?;
        let cells = grid
            .vertices
            .iter()
            .try_fold(size_of::<f32>(), |n, &v| n.checked_mul(v));
        let needed = cells.unwrap_or(usize::MAX);
        if needed > options.max_bytes {
            return Err(DistanceError::Memory {
                needed,
                limit: options.max_bytes,
            });
        }
        let [nx, ny, nz] = grid.vertices;
        let mut distances = vec![f32::INFINITY; nx * ny * nz];
        for &point in target {
            let [x, y, z] = grid.nearest_vertex(point).map(|v| v as usize);
            distances[(x * ny + y) * nz + z] = 0.0;
        }
        let strides = [ny * nz, nz, 1];
        for axis in 0..3 {
            sweep(&mut distances, grid.vertices, strides, axis, false);
            sweep(&mut distances, grid.vertices, strides, axis, true);
        }
        for distance in &mut distances {
            *distance *= grid.cell as f32;
        }
        Ok(Self { grid, distances })
    }

    /// Trilinear distance and gradient at `point`, see [`Sample`].
    #[inline]
    pub fn sample(&self, point: Point) -> Sample {
        let cell = self.grid.locate(point);
        let corners = core::array::from_fn(|i| {
            let i = i as u32;
            let [x, y, z] = cell.corner;
            self.at([x + (i >> 2), y + (i >> 1 & 1), z + (i & 1)])
        });
        let (distance, slope) = trilinear(corners, cell.fraction);
        let inverse = (1.0 / self.grid.cell) as f32;
        let gradient = core::array::from_fn(|a| slope[a] * inverse * cell.inside[a]);
        Sample { distance, gradient }
    }

    /// Bytes that the transform occupies.
    pub fn bytes(&self) -> usize {
        self.distances.len() * size_of::<f32>()
    }

    fn at(&self, vertex: [u32; 3]) -> f32 {
        let [x, y, z] = vertex.map(|v| v as usize);
        let [_, ny, nz] = self.grid.vertices;
        self.distances[(x * ny + y) * nz + z]
    }
}

/// One pass along `axis`: every cell takes the least of itself and the 3x3 cells of the plane
/// before it, one, sqrt 2 or sqrt 3 cells away.
fn sweep(distances: &mut [f32], counts: [usize; 3], strides: [usize; 3], axis: usize, back: bool) {
    let (second, third) = ((axis + 1) % 3, (axis + 2) % 3);
    for step in 1..counts[axis] {
        let (plane, before) = if back {
            let plane = counts[axis] - 1 - step;
            (plane, plane + 1)
        } else {
            (step, step - 1)
        };
        for a in 0..counts[second] {
            for b in 0..counts[third] {
                let place = |plane: usize, a: usize, b: usize| {
                    plane * strides[axis] + a * strides[second] + b * strides[third]
                };
                let mut least = distances[place(plane, a, b)];
                for near_a in a.saturating_sub(1)..=(a + 1).min(counts[second] - 1) {
                    for near_b in b.saturating_sub(1)..=(b + 1).min(counts[third] - 1) {
                        let aside = near_a.abs_diff(a) + near_b.abs_diff(b);
                        let length = (1.0 + aside as f32).sqrt();
                        least = least.min(distances[place(before, near_a, near_b)] + length);
                    }
                }
                distances[place(plane, a, b)] = least;
            }
        }
    }
}
