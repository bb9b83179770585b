//! Movers found, the static world kept still: rigid motions, cluster by cluster.
//!
//! ```text
//! source, ego motion out - cluster ─┐                 ┌ vote - starts
//! target ───────────────── scene ───┼─ each cluster: ─┤ rigid - the motion of least cost
//! both sweeps, whole ───── sight ───┘                 └ gate - needed, or none
//!                          spread: pieces beside a mover, points that are not of it - Motions
//! ```
//!
//! After ICP-Flow (Lin et al. 2024): clusters, shifts by votes, rigid fits; the cost both ways, the
//! gate and what is taken are ours. No field, no distance transform, no random choice: the same bits
//! whatever the number of threads. It must not know devices, backends or where an ego motion is from.

mod accept;
mod assign;
mod codec;
mod confidence;
mod describe;
mod features;
mod free_space;
mod gauss_newton;
mod hough;
mod hypothesis;
mod labels;
mod motion_field;
mod neighbor_view;
mod planar_motion;
mod scene;
mod search;
#[cfg(test)]
mod tests;

pub use confidence::{SURE_M, confidence_of_ground};
pub use describe::{Cluster, Objects};
pub use features::ConfidenceFeatures;
pub use labels::ClusterLabels;
pub use motion_field::ObjectMotions;
pub use search::{ObjectSearch, SearchClouds};

pub(crate) use search::find_objects;
