//! The distance transform of a target by either metric, FNSF Section 3.2.

use super::bricks::Bricks;
use super::chamfer::DenseChamfer;
use super::options::{DistanceError, DistanceOptions, Metric};
use super::sample::Sample;
use crate::flow::data::{Control, Point};

/// A distance transform of the target, with the metric of the options.
#[derive(Debug)]
pub enum DistanceTransform {
    /// Exact Euclidean distance in a narrow band, with a far field.
    Bricks(Bricks),
    /// The published code's chamfer metric on a dense grid.
    Chamfer(DenseChamfer),
}

impl DistanceTransform {
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
        Ok(match options.metric {
            Metric::Euclidean => Self::Bricks(Bricks::build(source, target, options, control)?),
            Metric::Chamfer => {
                Self::Chamfer(DenseChamfer::build(source, target, options, control)?)
            }
        })
    }

    /// Trilinear distance and gradient at `point`, see [`Sample`].
    #[inline]
    pub fn sample(&self, point: Point) -> Sample {
        match self {
            Self::Bricks(bricks) => bricks.sample(point),
            Self::Chamfer(dense) => dense.sample(point),
        }
    }

    /// Bytes that the transform occupies.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Bricks(bricks) => bricks.bytes(),
            Self::Chamfer(dense) => dense.bytes(),
        }
    }
}
