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
mod options;
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
