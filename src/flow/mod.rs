//! The numerics: scene flow of a pair of point clouds by run-time optimization.
//!
//! ```text
//! Problem - preprocess - backend.transform - align - start - loop { advance } - evaluate - Estimate
//! ```
//!
//! No async, no input or output, no clock, no environment, no globals. Deadlines, cancellation and
//! time come in through a [`Watch`].
pub mod backend;
pub mod cpu;
pub mod distance;
mod early_stop;
pub mod ego;
mod error;
pub mod evaluate;
pub mod field;
mod loss;
mod optimizer;
mod options;//!
//! ```
//! use fnsf::flow::cpu::CpuBackend;
//! use fnsf::flow::simulate::{Street, StreetOptions};
//! use fnsf::flow::{Preset, Problem, Unwatched, estimate};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let street = StreetOptions { beams: 16, azimuth_steps: 400, ..StreetOptions::default() };
//! let pair = Street::new(&street)?.pair(0)?;
//! let problem = Problem { source: &pair.source, target: &pair.target, ground: None };
//! let options = Preset::Default.options(None);
//! let estimate = estimate(&CpuBackend::new(None)?, &problem, &options, &Unwatched)?;
//! assert_eq!(estimate.flow.len(), pair.source.len());
//! # Ok(())
//! # }
//! ```

mod points;
mod preprocess;
mod random;
pub mod simulate;
mod solver;
mod watch;

#[cfg(test)]
mod reference;

pub use error::FlowError;
pub use options::*;
pub use points::{MIN_POINTS, Point, RigidTransform};
pub use preprocess::Problem;
pub use solver::{DYNAMIC_M, Estimate, PhaseSeconds, StopReason, estimate};
pub use watch::{Interrupt, Progress, Unwatched, Watch};
