//! Object search: a rigid motion for each cluster that moves, and none for the static world.
//!
//! ```text
//! source, ego motion out - clusters ─┐                 ┌ Hough voting - initial guesses
//! target ────────────────── scene ───┼─ each cluster: ─┤ fits - the hypothesis of least cost
//! both raw sweeps ───── free space ──┘                 └ acceptance - its motion, or none
//!     assignment: fragments beside moving objects, points that do not follow - ObjectMotions
//! ```
//!
//! After ICP-Flow (Lin et al. 2024): clusters, Hough voting over translations and rigid fits. The
//! symmetric cost, the acceptance test and the static matches are additions to it. There is no
//! random choice, and the result is bit-identical for any number of threads.

mod accept;
mod assign;
mod clouds;
mod cluster_cost;
mod codec;
mod confidence;
mod describe;
mod evidence;
mod features;
mod free_space;
mod gauss_newton;
mod hough;
mod hypothesis;
mod labels;
mod measured_at;
mod motion_field;
mod neighbor_view;
mod own_vehicle;
mod packed;
mod planar_motion;
mod scene;
mod search;
#[cfg(test)]
mod tests;

pub use confidence::{CONFIDENT_WITHIN_M, Probabilities};
pub use describe::{Cluster, Objects};
pub use features::ConfidenceFeatures;
pub use labels::ClusterLabels;
pub use motion_field::ObjectMotions;
pub use packed::{FoundInScene, PackedScene};
pub use search::{ObjectSearch, SearchClouds, SearchSeconds};

pub(crate) use measured_at::TimedPoints;
#[cfg(feature = "gpu")]
pub(crate) use packed::FoundRecord;
pub(crate) use search::{ClusterDevice, find_objects};

#[cfg(test)]
pub(crate) use packed::shared_constants;
/// What the kernel that searches clusters is compared with, for tests of its records.
#[cfg(test)]
pub(crate) use packed::{ClusterRecord, SceneRecord, ViewRecord};
