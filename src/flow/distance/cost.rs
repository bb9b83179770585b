//! The predicted cost of a distance transform: memory exactly, time by measured constants.

use super::brick_index::BRICK_BYTES;
use super::chamfer::DenseChamfer;
use super::coarse_field::CoarseField;
use super::options::{DistanceError, DistanceOptions, Metric, Sites};
use super::plan::Layout;
use super::transform::DistanceTransform;
use crate::flow::data::{Point, Uncontrolled};

/// Multiply-adds of the network that take as long as one brick with a band of 20 cells, for
/// [`Sites::Cells`].
const BRICK: f64 = 3.4e5;
/// The band of that measurement, cells.
const BRICK_BAND: f64 = 20.0;
/// Time of a brick for [`Sites::Points`], relative to [`Sites::Cells`]: 2.6 to 5.6 on four scenes.
const TO_POINTS: f64 = 4.0;
/// As [`BRICK`], for a vertex of the far field.
const FAR_VERTEX: f64 = 2.7e3;
/// As [`BRICK`], for a cell of the dense transform.
const DENSE_CELL: f64 = 5e3;

/// The predicted memory and computing time of a distance transform.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TransformCost {
    /// Number of stored bricks; 0 for [`Metric::Chamfer`].
    pub bricks: usize,
    /// Bytes that the finished transform occupies.
    pub bytes: usize,
    /// Predicted peak memory of the build, bytes, without the small buffers of each thread.
    pub peak_bytes: usize,
    /// Predicted computing time, in multiply-adds: the number of multiply-adds of the network's fit
    /// that take as long as the build. It is computed with constants measured on a CPU.
    pub multiply_adds: f64,
}

impl DistanceTransform {
    /// Predicts the memory and time of [`Self::build`] with the same arguments. It plans
    /// the grid and its bricks but computes no distances.
    ///
    /// # Errors
    /// [`DistanceError::Cell`], [`DistanceError::Band`], [`DistanceError::EmptyTarget`],
    /// [`DistanceError::Extent`] or [`DistanceError::Memory`] where [`Self::build`] returns them.
    pub fn predict_cost(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
    ) -> Result<TransformCost, DistanceError> {
        if options.metric == Metric::Chamfer {
            let grid = DenseChamfer::plan(source, target, options)?;
            let cells = grid.vertices.iter().product::<usize>();
            return Ok(TransformCost {
                bricks: 0,
                bytes: cells * size_of::<f32>(),
                peak_bytes: cells * size_of::<f32>(),
                multiply_adds: cells as f64 * DENSE_CELL,
            });
        }
        let layout = Layout::plan(source, target, options, &Uncontrolled)?;
        let bricks = layout.index.active;
        let far = CoarseField::vertices_over(&layout.grid);
        let bytes = layout.index.bytes() + bricks * BRICK_BYTES + far * size_of::<f32>();
        let sites = match options.sites {
            Sites::Cells => 1.0,
            Sites::Points => TO_POINTS,
        };
        let brick = BRICK * sites * f64::from(layout.band) / BRICK_BAND;
        Ok(TransformCost {
            bricks,
            bytes,
            peak_bytes: (bytes + layout.sites)
                .max(layout.index.bytes() + CoarseField::bytes_over(&layout.grid))
                + layout.cells.len() * size_of::<[u32; 3]>(),
            multiply_adds: bricks as f64 * brick + far as f64 * FAR_VERTEX,
        })
    }
}
