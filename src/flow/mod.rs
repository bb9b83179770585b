//! Scene flow estimation: the motion of every point between two lidar sweeps, by an object search
//! or by the fit of a neural field.
//!
//! ```text
//! Problem - select - registration - objects or field - Estimate
//! ```
//!
//! The module contains no async code, reads and writes no files, reads no clock and holds no global
//! state. The caller provides deadlines, cancellation and time through a [`Control`]. Of the
//! environment only `RAYON_NUM_THREADS` is read, for a thread pool of unspecified size.
//!
//! ```
//! use fnsf::flow::cpu::CpuBackend;
//! use fnsf::flow::simulate::{Street, StreetOptions};
//! use fnsf::flow::{Preset, Problem, Uncontrolled, estimate};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let street = StreetOptions { beams: 16, azimuth_steps: 400, ..StreetOptions::default() };
//! let pair = Street::new(&street)?.pair(0)?;
//! let problem = Problem::pair(&pair.source, &pair.target);
//! let options = Preset::Default.options(None);
//! let estimate = estimate(&CpuBackend::new(None)?, &problem, &options, &Uncontrolled)?;
//! assert_eq!(estimate.flow.len(), pair.source.len());
//! # Ok(())
//! # }
//! ```

// The estimate of a pair, of a sequence, and the prediction of its cost.
mod cost;
mod error;
mod estimate;
mod motion;
mod options;
mod problem;
mod select;
mod sequence;

// Shared data types, host threads and spatial indices.
mod data;
mod deskew;
mod host;
mod simd;
mod spatial;

// Ground segmentation and ego motion.
pub mod ground;
mod registration;

// The two methods: an object search, and the fit of a neural field on a backend.
pub mod cpu;
pub mod distance;
pub mod field;
#[cfg(feature = "gpu")]
pub mod gpu;
mod objects;

// Tracks, densification, depth images, metrics and simulated data.
pub mod densify;
pub mod depth;
pub mod evaluate;
pub mod simulate;
pub mod tracks;

pub use cost::{Cost, NeighborCost, neighbor_cost, predict_cost};
pub use data::{
    AlignedSweep, Control, DYNAMIC_M, DenseCloud, EnvelopeError, Interrupt, MIN_POINTS,
    OrientedBox, Point, Progress, RigidTransform, StopReason, Uncontrolled, rigid_motion_between,
};
pub use error::FlowError;
pub use estimate::{Deskew, Estimate, FieldSolution, ObjectSolution, Solution, estimate, resume};
pub use field::{Network, Snapshot, SnapshotError, TrainerState};
pub use host::{Host, HostError};
pub use motion::{MotionField, Residual, SampledMotion};
pub use objects::{
    CONFIDENT_WITHIN_M, Cluster, ClusterLabels, ConfidenceFeatures, FoundInScene, ObjectMotions,
    ObjectSearch, Objects, PackedScene, Probabilities, SearchClouds, SearchSeconds,
};
pub use options::*;
pub use problem::{NeighborSweep, Problem};
pub use registration::Registration;
pub use sequence::{Sequence, Sweep, WindowedPair, is_window_final, neighbor_at, window};

#[cfg(feature = "service")]
pub(crate) use data::{largest, locked};
