//! The regular grid that a distance transform is sampled on: its vertices, and the cell of a point.
//!
//! As in the published code, it extends over both clouds and one cell more on every side.

use super::options::DistanceError;
use crate::flow::data::Point;

/// A regular, axis-parallel grid of nx x ny x nz vertices, `cell` metres apart.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Position of vertex (0, 0, 0), metres.
    pub origin: [f64; 3],
    /// Distance between neighboring vertices, metres.
    pub cell: f64,
    /// Number of vertices along x, y and z, each at least 2.
    pub vertices: [usize; 3],
}

/// A position between the vertices: the lower corner of its cell, and the fraction beyond it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cell {
    pub(crate) corner: [u32; 3],
    pub(crate) fraction: [f32; 3],
    /// Per axis, 1 if the point lies within the grid, else 0.
    pub(crate) inside: [f32; 3],
}

impl Grid {
    /// The longest extent of the clouds along an axis, metres. A single-precision coordinate of
    /// that size has a resolution of 2 mm.
    pub const MAX_EXTENT_M: f64 = 20_000.0;

    /// The grid that covers `source` (N x 3, metres) and `target` (M x 3, metres), with cells of
    /// `cell` metres. As in the published code, it extends at least one cell beyond the clouds on
    /// every side. `cell` must be at least 0.001, and coordinates must not be NaN. Neither is
    /// checked, and the grid would be wrong.
    ///
    /// # Errors
    /// - [`DistanceError::EmptyTarget`] if `target` has no points.
    /// - [`DistanceError::Extent`] if both clouds together span more than [`Self::MAX_EXTENT_M`]
    ///   along an axis, or a coordinate is infinite.
    pub fn covering(source: &[Point], target: &[Point], cell: f64) -> Result<Self, DistanceError> {
        if target.is_empty() {
            return Err(DistanceError::EmptyTarget);
        }
        let mut low = [f32::INFINITY; 3];
        let mut high = [f32::NEG_INFINITY; 3];
        for point in source.iter().chain(target) {
            for axis in 0..3 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
        }
        let extent: [f64; 3] = core::array::from_fn(|a| f64::from(high[a]) - f64::from(low[a]));
        if extent
            .iter()
            .any(|e| !(0.0..=Self::MAX_EXTENT_M).contains(e))
        {
            return Err(DistanceError::Extent {
                x_m: extent[0],
                y_m: extent[1],
                z_m: extent[2],
                limit_m: Self::MAX_EXTENT_M,
            });
        }
        let first = low.map(|x| (f64::from(x) / cell - 1.0).floor());
        let last = high.map(|x| (f64::from(x) / cell + 1.0).ceil());
        Ok(Self {
            origin: first.map(|x| x * cell),
            cell,
            vertices: core::array::from_fn(|a| (last[a] - first[a]) as usize + 2),
        })
    }

    /// `point` in cells from the origin.
    pub(crate) fn in_cells(&self, point: Point) -> [f64; 3] {
        core::array::from_fn(|a| (f64::from(point[a]) - self.origin[a]) / self.cell)
    }

    /// The vertex nearest to `point`, ties to even, as the published code rasterizes the target.
    pub(crate) fn nearest_vertex(&self, point: Point) -> [u32; 3] {
        let at = self.in_cells(point);
        core::array::from_fn(|axis| {
            at[axis]
                .round_ties_even()
                .clamp(0.0, (self.vertices[axis] - 1) as f64) as u32
        })
    }
}

/// The grid in single precision, as every device samples it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lattice {
    /// Position of the first vertex, metres: the sum of a high and a low float per axis.
    pub(crate) origin_high: Point,
    pub(crate) origin_low: Point,
    pub(crate) inverse_cell: f32,
    /// Vertices along each axis.
    pub(crate) vertices: [u32; 3],
}

impl Lattice {
    pub(crate) fn new(grid: &Grid) -> Self {
        let high = grid.origin.map(|x| x as f32);
        Self {
            origin_high: high,
            origin_low: core::array::from_fn(|a| (grid.origin[a] - f64::from(high[a])) as f32),
            inverse_cell: (1.0 / grid.cell) as f32,
            vertices: grid.vertices.map(|n| n as u32),
        }
    }

    /// The cell of `point` and its position there. Points outside the grid are clamped to its
    /// border.
    #[inline]
    pub(crate) fn locate(&self, point: Point) -> Cell {
        let mut cell = Cell {
            corner: [0; 3],
            fraction: [0.0; 3],
            inside: [1.0; 3],
        };
        let in_cells = |axis: usize| {
            let from_origin = (point[axis] - self.origin_high[axis]) - self.origin_low[axis];
            from_origin * self.inverse_cell
        };
        for (axis, at) in [0, 1, 2].map(in_cells).into_iter().enumerate() {
            let clipped = at.clamp(0.0, (self.vertices[axis] - 1) as f32);
            if clipped != at {
                cell.inside[axis] = 0.0;
            }
            let corner = (clipped as u32).min(self.vertices[axis] - 2);
            cell.corner[axis] = corner;
            cell.fraction[axis] = clipped - corner as f32;
        }
        cell
    }
}

/// Trilinear value of eight corners (`corners[4 x + 2 y + z]`) and its derivative with respect to
/// the fraction.
#[inline]
pub(crate) fn trilinear(corners: [f32; 8], fraction: [f32; 3]) -> (f32, [f32; 3]) {
    let [x, y, z] = fraction;
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let along_z: [f32; 4] = core::array::from_fn(|i| mix(corners[2 * i], corners[2 * i + 1], z));
    let slope_z: [f32; 4] = core::array::from_fn(|i| corners[2 * i + 1] - corners[2 * i]);
    let (low, high) = (
        mix(along_z[0], along_z[1], y),
        mix(along_z[2], along_z[3], y),
    );
    let dx = high - low;
    let dy = mix(along_z[1] - along_z[0], along_z[3] - along_z[2], x);
    let dz = mix(
        mix(slope_z[0], slope_z[1], y),
        mix(slope_z[2], slope_z[3], y),
        x,
    );
    (mix(low, high, x), [dx, dy, dz])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_is_the_published_one() {
        let source = [[-1.05, 2.0, 0.33]];
        let target = [[3.0, 2.25, 0.33]];
        let grid = Grid::covering(&source, &target, 0.1).unwrap();
        let [x, y, z] = grid.origin;
        assert!((x + 1.2).abs() < 1e-9 && (y - 1.9).abs() < 1e-9 && (z - 0.2).abs() < 1e-9);
        // ceil((3.0 + 0.1 + 1.2) / 0.1) + 2, and so on.
        assert_eq!(grid.vertices, [45, 7, 5]);
    }
}
