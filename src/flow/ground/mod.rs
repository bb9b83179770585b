//! Ground segmentation of one raw sweep of any spinning lidar, without a map and without
//! calibration.
//!
//! ```text
//! points - columns - height field, 32 m cells to 1 m cells - is there any ground? - flags
//! ```
//!
//! The sweep is divided into vertical columns. A smooth height field is fitted under the lowest
//! layers of the columns, coarse to fine. This is the cloth simulation filter (Zhang et al. 2016),
//! written as a linear problem. The flatness of columns as evidence of ground is that of Patchwork
//! (Lim et al. 2021). Points near the height field are ground.

mod columns;
mod mask;
mod options;
mod segment;
mod surface;

pub use options::GroundOptions;
pub use segment::{GroundSegmentation, segment};

pub(crate) use mask::mask;
