//! Pictures of flow, of tracks and of dense clouds from above, and of depth images; plots.
//!
//! Independent of files and of how flow and depth were computed.

mod motion;
mod wheel;

mod boxes;
mod canvas;
mod dense;
mod depth;
mod font;
mod plot;
mod top_down;
mod tracks;

pub use crate::picture::canvas::{Image, PictureError, write_png};
pub use crate::picture::dense::{DenseColors, dense_from_above};
pub use crate::picture::depth::{DepthPanel, depth_panels};
pub use crate::picture::motion::{full_scale, shown_motion};
pub use crate::picture::plot::{Axis, Plot, Series};
pub use crate::picture::top_down::{TopDown, TopDownOptions, top_down};
pub use crate::picture::tracks::{TracksFromAbove, tracks_from_above};
pub use crate::picture::wheel::{INVALID_COLOR, color};
