//! The points of a fit on the grid of the linear model.

use core::ops::Range;

use super::linear::LinearGrid;
use crate::flow::data::Point;

impl LinearGrid {
    /// Where `point` lies. Beyond the grid it is the nearest position on its border.
    pub(crate) fn place(&self, point: Point) -> Placed {
        let (voxel, sigma) = (f64::from(self.voxel_m), f64::from(self.sigma_m));
        let kernel = |off: f64| (-0.25 * (off / sigma).powi(2)).exp();
        let across = kernel(voxel);
        let mut cell = [0; 3];
        let mut weights = [[0.0; 2]; 3];
        for axis in 0..3 {
            let cells = (self.vertices[axis] - 1) as f64;
            let off = f64::from(point[axis]) - f64::from(self.origin[axis]);
            let at = (off / voxel).clamp(0.0, cells);
            let lower = at.floor().min(cells - 1.0);
            let near = (at - lower) * voxel;
            let [low, high] = [kernel(near), kernel(voxel - near)];
            let whole = 1.0 - across * across;
            weights[axis] = [low - high * across, high - low * across].map(|w| (w / whole) as f32);
            // A coordinate that is not a number counts as zero.
            cell[axis] = lower as u32;
        }
        Placed { cell, weights }
    }

    /// The points `range` of `placed` in the order of their voxels: the index of each one's voxel
    /// and its position, ascending. Every backend sums the gradients of a vertex in this order.
    pub(crate) fn by_voxel(&self, placed: &[Placed], range: Range<usize>) -> Vec<[u32; 2]> {
        let mut order: Vec<[u32; 2]> = range
            .map(|position| [self.voxel(&placed[position]), position as u32])
            .collect();
        order.sort_unstable();
        order
    }

    /// The index of a point's voxel: of its lower vertex, without the padding of rows.
    fn voxel(&self, placed: &Placed) -> u32 {
        let [x, y, z] = placed.cell;
        (z * self.vertices[1] as u32 + y) * self.vertices[0] as u32 + x
    }

    /// Voxel indices of one level.
    pub(crate) fn voxels_of_a_level(&self) -> u32 {
        (self.vertices[0] * self.vertices[1]) as u32
    }
}

/// A point's voxel, and the weights of its lower and upper vertices along each axis.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Placed {
    pub(crate) cell: [u32; 3],
    pub(crate) weights: [[f32; 2]; 3],
}

impl Placed {
    /// The flow of the point, from the displacements of all vertices.
    #[inline]
    pub(crate) fn blend(&self, grid: &LinearGrid, values: &[f32]) -> Point {
        let [x, y, z] = self.cell.map(|cell| cell as usize);
        let [wx, wy, wz] = self.weights;
        let first = z * grid.plane() + y * grid.row() + x;
        core::array::from_fn(|channel| {
            let values = &values[channel * grid.channel() + first..];
            let mut sum = 0.0;
            for (up, wz) in wz.into_iter().enumerate() {
                for (across, wy) in wy.into_iter().enumerate() {
                    let at = up * grid.plane() + across * grid.row();
                    sum += wz * wy * (wx[0] * values[at] + wx[1] * values[at + 1]);
                }
            }
            sum
        })
    }
}
