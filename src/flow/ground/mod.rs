//! Ground segmentation of one raw sweep of any spinning lidar, without a map and without
//! calibration.
//!
//! ```text
//! points - columns - height field, 32 m cells to 1 m cells - is there any ground? - flags
//! ```
//!
//! The sweep is divided into vertical columns. A smooth height field is fitted under the lowest
//! layers of the columns, coarse to fine, like a cloth laid from below. This is the idea of the
//! cloth simulation filter of Zhang et al., with the flatness test of Patchwork in place of its
//! forces. Points near the height field are ground.

mod columns;
mod mask;
mod options;
mod segment;
mod surface;

pub use options::GroundOptions;
pub use segment::{GroundSegmentation, segment};

pub(crate) use mask::mask;
