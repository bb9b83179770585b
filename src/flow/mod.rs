//! The numerics: scene flow of a pair of point clouds by run-time optimization.
//!
//! No async, no input or output, no clock, no environment, no globals.

mod points;
mod random;

pub mod evaluate;
pub mod simulate;

pub use points::{Point, RigidTransform};
