//! What a deformed point is pulled toward: the distance to the target cloud, anywhere in space.
//!
//! [`Bricks`] is the product's transform; [`DenseChamfer`] is the published code's, for comparison.
//! FNSF Section 3.2. Knows nothing of networks or losses.

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
#[cfg(test)]
mod tests;
mod transform;
mod vertex_distance;

pub use bricks::Bricks;
pub use chamfer::DenseChamfer;
pub use cost::TransformPrice;
pub use grid::Grid;
pub use options::{DistanceError, DistanceOptions, Metric, Sites};
pub use transform::{DistanceTransform, Sample};

#[cfg(feature = "gpu")]
pub(crate) use brick_index::{ABSENT, Index};
#[cfg(feature = "gpu")]
pub(crate) use coarse_field::FarField;
#[cfg(feature = "gpu")]
pub(crate) use fill::codes_per_cell;
#[cfg(feature = "gpu")]
pub(crate) use grid::Lattice;
#[cfg(feature = "gpu")]
pub(crate) use plan::Layout;
#[cfg(feature = "gpu")]
pub(crate) use vertex_distance::CellSites;
