//! Registration (GICP on surfels): the ego motion `target_from_source`, which aligns most source
//! points with the target.
//!
//! ```text
//! two clouds - voxel downsampling - coarse surfels: fits from up to nine initial guesses
//!   - fine surfels: refinement, weighed against how vehicles move - motion and covariance
//! ```
//!
//! The distances are plane to plane with robust weights, and the search starts from a prior. The
//! clouds should include the ground. Without it little else determines pitch, roll and height.

mod align;
mod coarse;
mod gicp;
mod overlap;
mod posterior;
mod sums;
mod surfels;
#[cfg(test)]
mod tests;

pub use align::Registration;
pub(crate) use align::{SurfelCloud, align};
pub(crate) use overlap::overlap;
