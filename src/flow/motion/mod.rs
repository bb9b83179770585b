//! The motion between two sweeps at any point, for the neural method and for the object method.

mod codec;
mod motion_field;
mod samples;

pub use motion_field::{MotionField, Residual};
pub use samples::SampledMotion;
