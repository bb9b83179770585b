//! Distance transforms of the target cloud, FNSF Section 3.2.
//!
//! [`Bricks`] is the default transform. [`DenseChamfer`] is the published code's, for comparison.
//! Independent of networks and losses.

mod brick_index;
mod bricks;
mod chamfer;
mod coarse_field;
mod cost;
mod fill;
mod grid;
mod options;
mod plan;
mod point_distance;
mod sample;
#[cfg(test)]
mod tests;
mod transform;
mod vertex_distance;

pub use bricks::Bricks;
pub use chamfer::DenseChamfer;
pub use cost::TransformCost;
pub use grid::Grid;
pub use options::{DistanceError, DistanceOptions, Metric, Sites};
pub use sample::Sample;
pub use transform::DistanceTransform;

#[cfg(feature = "gpu")]
pub(crate) use brick_index::{ABSENT, Index};
#[cfg(feature = "gpu")]
pub(crate) use coarse_field::CoarseField;
#[cfg(feature = "gpu")]
pub(crate) use fill::codes_per_cell;
#[cfg(feature = "gpu")]
pub(crate) use grid::Lattice;
#[cfg(feature = "gpu")]
pub(crate) use plan::Layout;
#[cfg(feature = "gpu")]
pub(crate) use vertex_distance::VertexSites;
