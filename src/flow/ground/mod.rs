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

// What a sweep says about the ground, what is fitted to it, and the answer.
mod columns;
mod options;
mod segment;
mod surface;

pub use options::GroundOptions;
pub use segment::{GroundSegmentation, segment};

use super::Point;

/// Which of the points are ground, by the usual options; all of them are finite and in range.
pub(crate) fn mask(points: &[Point]) -> Vec<bool> {
    segment(points, &GroundOptions::default()).ground
}
