//! TODO doc

use super::bricks::Bricks;
use super::chamfer::DenseChamfer;
use super::options::{DistanceError, DistanceOptions, Metric};
use crate::flow::data::{Control, Point, Uncontrolled};

/// The distance at a point and how it changes with the point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sample {
    /// Metres to the target.
    pub distance: f32,
    /// Derivative of `distance` by x, y and z; zero along an axis on which the point lies outside
    /// the grid.
    pub gradient: Point,
}

/// A distance transform of the target, as the options asked for it.
#[derive(Debug)]
pub enum DistanceTransform {
    /// Exact Euclidean, narrow band with a far field.
    Bricks(Bricks),
    /// The published code's chamfer metric on a dense grid.
    Chamfer(DenseChamfer),
}

impl DistanceTransform {
    /// Transforms `target` over a grid that covers both clouds.
    ///
    /// # Errors
    /// [`DistanceError`] where the options make no sense or the clouds span too much space.
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
        Ok(match options.metric {
            Metric::Euclidean => {
                Self::Bricks(Bricks::build_watched(source, target, options, control)?)
            }
            Metric::Chamfer => Self::Chamfer(DenseChamfer::build_watched(
                source, target, options, control,
            )?),
        })
    }

    /// Trilinear distance and gradient at `point`.
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
