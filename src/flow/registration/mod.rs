//! Ego motion: the rigid motion that carries most source points onto the target.
//!
//! ```text
//! two clouds - thinned - search: up to nine starts on coarse surfels - refinement on fine ones - motion
//! ```
//!
//! Plane to plane on evenly thinned clouds, robustly weighted, from a prior. Needs the ground, which
//! alone holds pitch, roll and height. It must not know of fields, flows or distance transforms.

mod align;
mod coarse;
mod gicp;
pub(crate) mod neighbors;
mod surfels;
#[cfg(test)]
mod tests;

pub use neighbors::{AlignedSweep, NeighborSweep};

pub(crate) use align::{SurfelCloud, align};
