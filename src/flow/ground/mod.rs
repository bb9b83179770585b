//! Which points of one raw sweep lie on the ground: any spinning lidar, no map, no calibration.
//!
//! ```text
//! points - columns - surface, 32 m cells to 1 m cells - is there ground at all? - flags
//! ```
//!
//! The sweep is cut into upright columns. A smooth surface is laid under the columns' lowest
//! layers, coarse to fine, as cloth would be from below (the idea of Zhang et al.'s cloth
//! simulation filter, with the flatness test of Patchwork in place of its forces), and points near
//! it are ground. It must not know of rings, sensors, labels or the other sweep.

mod columns;
mod mask;
mod options;
mod segment;
mod surface;

pub use options::GroundOptions;
pub use segment::{GroundSegmentation, segment};

pub(crate) use mask::mask;
