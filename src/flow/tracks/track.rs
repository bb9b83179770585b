//! A track: one object over time.

use crate::flow::data::{OrientedBox, Point};

/// One moving object over a sequence.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Track {
    /// Identity of the object, from 1, unique in its sequence.
    pub id: u32,
    /// Its states, one for each sweep from its first to its last, in order.
    pub states: Vec<TrackState>,
}

/// An object in one sweep.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackState {
    /// Index of the sweep in the sequence, from 0.
    pub sweep: u32,
    /// Upright box in the frame of the sweep, metres. All boxes of a track have one size. The
    /// length is along the heading, which is the direction of the last motion.
    pub bounds: OrientedBox,
    /// Velocity of its center with the ego motion taken out, m/s along the axes of the sweep's
    /// frame.
    pub velocity: Point,
    /// Yaw rate about the vertical, rad/s, positive counterclockwise.
    pub yaw_rate: f32,
    /// Number of rows of the sweep that the object has. Zero where it is hidden or where the sweep
    /// has no estimate: the state is then predicted at constant velocity and yaw rate.
    pub points: u32,
    /// Mean confidence of these rows, 0 to 1. Zero for a predicted state.
    pub confidence: f32,
}
