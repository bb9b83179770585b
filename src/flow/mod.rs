//! The numerics: scene flow of a pair of point clouds by run-time optimization.
//!
//! ```text
//! Problem - preprocess - backend.transform - align - start - loop { advance } - evaluate - Estimate
//! ```
//!
//! No async, no input or output, no clock, no environment, no globals. Deadlines, cancellation and
//! time come in through a [`Watch`].
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

// What goes in and comes out, and the loop between.
mod around;
mod deadline;
mod dense;
mod error;
mod options;
mod points;
mod preprocess;
mod price;
mod sealed;
mod sequence;
mod snapshot;
mod solver;
mod warm_start;
mod watch;

// What a point is pulled toward, and what moves it.
pub mod distance;
mod ego;
pub mod field;
mod flat;
mod label;
mod loss;

// What is said of a sweep's points besides.
mod bounds;
mod objects;

// What carries no motion of its own.
pub mod ground;

// What becomes of a sequence.
pub mod densify;

// How the field is fitted, and on what.
pub mod backend;
mod course;
pub mod cpu;
mod early_stop;
#[cfg(feature = "gpu")]
pub mod gpu;
mod host;
mod once;
mod optimizer;
mod recall;
mod sums;

// What a camera sees of a cloud.
pub mod depth;

// How good a flow is, and streets to try it on.
pub mod evaluate;
mod random;
pub mod simulate;

#[cfg(test)]
mod reference;

pub use around::{AlignedSweep, Around};
pub use bounds::Bounds;
pub use dense::DenseCloud;
pub use error::FlowError;
pub use field::{Field, Network, Residual};
pub use host::Host;
pub use label::{Clouds, Evidence, Labelled, Motions, Parts, SURE_M, confidence_of_ground};
pub use objects::{Cluster, Objects};
pub use options::*;
pub use points::{DYNAMIC_M, MIN_POINTS, Point, RigidTransform};
pub use preprocess::Problem;
pub use price::{AroundPrice, Price, price, price_around};
pub use sealed::SealError;
pub use sequence::{Sequence, Sweep, is_whole, window};
pub use snapshot::{Snapshot, SnapshotError, TrainerState};
pub use solver::{Estimate, PhaseSeconds, StopReason, estimate, resume};
pub use watch::{Interrupt, Progress, Unwatched, Watch};
