//! The distance transform of a target by either metric, FNSF Section 3.2.

use super::bricks::Bricks;
use super::chamfer::DenseChamfer;
use super::options::{DistanceError, DistanceOptions, Metric};
use super::sample::Sample;
use crate::flow::data::{Control, Point};

/// A distance transform of a target cloud (FNSF Section 3.2), of either [`Metric`].
#[derive(Debug)]
pub enum DistanceTransform {
    /// Of [`Metric::Euclidean`]: exact near the target, approximate farther away.
    Bricks(Bricks),
    /// Of [`Metric::Chamfer`]: the published code's transform on a dense grid.
    Chamfer(DenseChamfer),
}

impl DistanceTransform {
    /// Builds the transform of `target` (M x 3, metres) on a grid that covers `target` and `source`
    /// (N x 3, metres). `options.metric` selects the variant. `source` affects only the size of the
    /// grid. Coordinates must not be NaN: this is not checked, and the distances would be wrong.
    ///
    /// `control` is checked before each part of the work, see [`Bricks::build`] and
    /// [`DenseChamfer::build`].
    ///
    /// # Errors
    /// - [`DistanceError::Cell`] if `options.cell_m` is not finite or below 0.001 m.
    /// - [`DistanceError::Band`] if `options.band_m`, in cells and rounded, is not 1 to 64.
    /// - [`DistanceError::EmptyTarget`] if `target` has no points.
    /// - [`DistanceError::Extent`] if both clouds together span more than
    ///   [`super::Grid::MAX_EXTENT_M`] along an axis, or a coordinate is infinite.
    /// - [`DistanceError::Memory`] if more than `options.max_bytes` are needed. For
    ///   [`Metric::Euclidean`] also if the grid has more than 2^24 blocks of 64 x 64 x 64 vertices.
    /// - [`DistanceError::Interrupted`] if `control` interrupts.
    pub fn build(
        source: &[Point],
        target: &[Point],
        options: &DistanceOptions,
        control: &dyn Control,
    ) -> Result<Self, DistanceError> {
        Ok(match options.metric {
            Metric::Euclidean => Self::Bricks(Bricks::build(source, target, options, control)?),
            Metric::Chamfer => {
                Self::Chamfer(DenseChamfer::build(source, target, options, control)?)
            }
        })
    }

    /// The distance from `point` (x, y, z in metres) to the target, and its gradient.
    ///
    /// The distance, metres, is interpolated trilinearly between the vertices of the grid. The
    /// gradient is the derivative of that interpolation and has no unit. Outside the grid the
    /// distance is that of the nearest position on the grid's border. The gradient is then zero
    /// along each axis on which the point lies outside. A NaN coordinate gives a NaN distance.
    #[inline]
    pub fn sample(&self, point: Point) -> Sample {
        match self {
            Self::Bricks(bricks) => bricks.sample(point),
            Self::Chamfer(dense) => dense.sample(point),
        }
    }

    /// Bytes of memory that the transform occupies.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Bricks(bricks) => bricks.bytes(),
            Self::Chamfer(dense) => dense.bytes(),
        }
    }
}
