//! The estimate of one pair.
//!
//! ```text
//! Problem - select - ego motion - by objects or by field - Estimate
//! ```

mod by_cluster;
mod by_field;
mod by_objects;
mod deskewing;
mod ego_motion;
mod method;
mod neighbors;
mod result;
mod run;
#[cfg(test)]
mod tests;

pub use deskewing::Deskew;
pub use result::{Estimate, FieldSolution, ObjectSolution, Solution};
pub use run::{estimate, resume};
