//! Pictures of flow: color by direction, seen from above; and of depth, seen by a camera.
//!
//! It knows points and pixels; it must not know where either came from.

mod motion;
mod wheel;

mod boxes;
mod canvas;
mod depth;
mod font;
mod top_down;

pub use canvas::{Image, PictureError, write_png};
pub use depth::{DepthPanel, depth_panels};
pub use motion::{full_scale, shown_motion};
pub use top_down::{TopDown, TopDownOptions, top_down};
pub use wheel::{INVALID_COLOR, color};
