//! The numerics: scene flow of a pair of point clouds by run-time optimization.
//!
//! No async, no input or output, no clock, no environment, no globals.

mod points;

pub mod evaluate;

pub use points::{Point, RigidTransform};
