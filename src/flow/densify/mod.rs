//! One dense cloud of a sequence: every sweep's points, carried into one frame by Euler integration.
//!
//! ```text
//! sweep - static place: T x - y <- y + g(y) / substeps, again - next sweep's frame - ... - the frame
//! ```
//!
//! The ego motion is taken out of every step and put back exactly, so that the static world does
//! not drift; what the fields say is integrated only where it counts as motion. Ground never moves
//! of itself. Knows no files, and not how the fields were fitted.

mod accumulate;
mod advect;
mod plan;
#[cfg(test)]
mod tests;

pub use accumulate::{DensifyError, carrier, densify};
pub use plan::{FlowEdge, LaterSweeps, Plan, PlanError};
