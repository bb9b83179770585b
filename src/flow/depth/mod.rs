//! Depth images of lidar clouds: projection into a pinhole camera, occlusion filter and error
//! measures.

mod camera;
mod compare;
mod hidden;
mod image;

pub use camera::{Camera, CameraError, Intrinsics, MAX_SIDE_PX};
pub use compare::{DepthErrors, SizeMismatch};
pub use hidden::Occlusion;
pub use image::{DepthImage, project};
