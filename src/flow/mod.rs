//! The numerics: scene flow of a pair of point clouds by run-time optimization.
//!
//! No async, no input or output, no clock, no environment, no globals.

pub mod backend;
pub mod cpu;
pub mod distance;
mod early_stop;
pub mod field;
mod optimizer;
mod options;
mod points;
mod random;
<<<<<<< HEAD
mod watch;
=======

pub mod evaluate;
pub mod simulate;
>>>>>>> street

pub use options::*;
pub use points::{Point, RigidTransform};
pub use watch::*;
