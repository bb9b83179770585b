//! Densification: one dense cloud from a sequence, with every sweep transformed into one frame by
//! Euler integration of motion fields.
//!
//! ```text
//! sweep -> static position x = T p -> x <- x + g(x) / substeps, repeated -> next sweep's frame
//!       -> ... -> frame of the reference time
//! ```
//!
//! Each step applies the ego motion exactly and integrates only the residual motion, so that the
//! static world does not drift. Residuals below the threshold of motion are ignored. Ground points
//! have no residual motion where there is an ego motion.

mod accumulate;
mod advect;
mod error;
mod fields;
mod plan;
#[cfg(test)]
mod tests;

pub use accumulate::{carrier, densify};
pub use error::DensifyError;
pub use fields::{FieldStep, estimate_fields};
pub use plan::{FlowEdge, LaterSweeps, Plan, PlanError};
