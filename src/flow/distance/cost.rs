//! What a distance transform will take: its bytes exactly, its work by measured constants.

use super::brick_index::BRICK_BYTES;
use super::chamfer::DenseChamfer;
use super::coarse_field::FarField;
use super::options::{DistanceError, DistanceOptions, Metric, Sites};
use super::plan::Layout;
use super::transform::DistanceTransform;
use crate::flow::data::{Point, Uncontrolled};

/// Multiply-adds of the network that take as long as a brick with a band of 20 cells, to cells.
const BRICK: f64 = 3.4e5;
/// The band for which that is so.
const BRICK_BAND: f64 = 20.0;
/// What a brick takes to points, in bricks to cells: 2.6 to 5.6 on four scenes.
const TO_POINTS: f64 = 4.0;
/// As [`BRICK`], for a vertex of the far field.
const FAR_VERTEX: f64 = 2.7e3;
/// As [`BRICK`], for a cell of the dense transform.
const DENSE_CELL: f64 = 5e3;

/// What a distance transform will take.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TransformPrice {
    /// Active bricks; none of a dense transform.
    pub bricks: usize,
    /// Bytes that it will occupy.
    pub bytes: usize,
    /// Bytes that building it takes at most.
    pub peak_bytes: usize,
    /// Work: as many multiply-adds of the network take as long.
    pub multiply_adds: f64,
}

impl DistanceTransform {
    /// What [`Self::build`] will take.
    ///
    /// # Errors
    /// As [`Self::build`].
    pub fn price(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
    ) -> Result<TransformPrice, DistanceError> {
        if options.metric == Metric::Chamfer {
            let grid = DenseChamfer::plan(source, target, options)?;
            let cells = grid.vertices.iter().product::<usize>();
            return Ok(TransformPrice {
                bricks: 0,
                bytes: cells * size_of::<f32>(),
                peak_bytes: cells * size_of::<f32>(),
                multiply_adds: cells as f64 * DENSE_CELL,
            });
        }
        let layout = Layout::plan(source, target, options, &Uncontrolled)?;
        let bricks = layout.index.active;
        let far = FarField::vertices_over(&layout.grid);
        let bytes = layout.index.bytes() + bricks * BRICK_BYTES + far * size_of::<f32>();
        let sites = match options.sites {
            Sites::Cells => 1.0,
            Sites::Points => TO_POINTS,
        };
        let brick = BRICK * sites * f64::from(layout.band) / BRICK_BAND;
        Ok(TransformPrice {
            bricks,
            bytes,
            peak_bytes: (bytes + layout.sites)
                .max(layout.index.bytes() + FarField::bytes_over(&layout.grid))
                + layout.cells.len() * size_of::<[u32; 3]>(),
            multiply_adds: bricks as f64 * brick + far as f64 * FAR_VERTEX,
        })
    }
}
