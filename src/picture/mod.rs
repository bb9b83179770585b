//! Pictures of flow: color by direction, seen from above.
//!
//! It knows points and pixels; it must not know where either came from.

mod motion;
mod wheel;

pub use motion::{full_scale, shown_motion};
pub use wheel::{INVALID_COLOR, color};
