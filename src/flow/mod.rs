//! The numerics: scene flow of a pair of point clouds by run-time optimization.
//!
//! ```text
//! Problem - select - registration - objects or field - Estimate
//! ```
//!
//! No async, no input or output, no clock, no environment, no globals. Deadlines, cancellation and
//! time come in through a [`Control`].
//!
//! ```
//! use fnsf::flow::cpu::CpuBackend;
//! use fnsf::flow::simulate::{Street, StreetOptions};
//! use fnsf::flow::{Preset, Problem, Unwatched, estimate};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let street = StreetOptions { beams: 16, azimuth_steps: 400, ..StreetOptions::default() };
//! let pair = Street::new(&street)?.pair(0)?;
//! let problem = Problem { source: &pair.source, target: &pair.target, ground: None, before: None, around: &[] };
//! let options = Preset::Default.options(None);
//! let estimate = estimate(&CpuBackend::new(None)?, &problem, &options, &Unwatched)?;
//! assert_eq!(estimate.flow.len(), pair.source.len());
//! # Ok(())
//! # }
//! ```

// The estimate of a pair and of a sequence, and its cost.
mod cost;
mod error;
mod estimate;
mod motion;
mod options;
mod select;
mod sequence;

// Data and searches in space that all rooms share.
mod data;
mod host;
mod spatial;

// Ground and ego motion.
pub mod ground;
mod registration;

// The two methods: objects, and a neural field on a device.
pub mod cpu;
pub mod distance;
pub mod field;
#[cfg(feature = "gpu")]
pub mod gpu;
mod objects;

// Results of a sequence, depth images, metrics and simulated data.
pub mod densify;
pub mod depth;
pub mod evaluate;
pub mod simulate;

pub use cost::{Cost, NeighborCost, neighbor_cost, price};
pub use data::{
    Control, DYNAMIC_M, DenseCloud, EnvelopeError, Interrupt, MIN_POINTS, OrientedBox, Point,
    Progress, RigidTransform, Uncontrolled,
};
pub use error::FlowError;
pub use estimate::{Estimate, PhaseSeconds, StopReason, estimate, resume};
pub use field::{Network, Snapshot, SnapshotError, TrainerState};
pub use host::Host;
pub use motion::{MotionField, Residual};
pub use objects::{
    Cluster, ClusterLabels, ConfidenceFeatures, ObjectMotions, ObjectSearch, Objects, SURE_M,
    SearchClouds, confidence_of_ground,
};
pub use options::*;
pub use registration::{AlignedSweep, NeighborSweep};
pub use select::Problem;
pub use sequence::{Sequence, Sweep, is_whole, window};
