//! Clouds seen through a camera: how deep each pixel is, and how well that is known.
//!
//! It must not know where points or cameras came from, nor files.

mod camera;
mod compare;
mod hidden;
mod image;

pub use camera::{Camera, CameraError, Intrinsics, MAX_SIDE_PX};
pub use compare::{DepthErrors, SizeMismatch};
pub use hidden::Occlusion;
pub use image::{DepthImage, project};
