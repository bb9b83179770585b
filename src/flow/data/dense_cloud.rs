//! A dense cloud: the points of several sweeps, transformed into one frame.

use super::point::Point;

/// The points of several sweeps in one frame: M points, one row each in every list.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DenseCloud {
    /// M x 3: position of each point at the reference time, metres, in the frame of the reference
    /// time.
    pub points: Vec<Point>,
    /// M: index in the sequence of the sweep that measured each point, counted from 0.
    pub sweep: Vec<u32>,
    /// M: the reference time minus the time of the point's sweep, in sweep intervals; negative if
    /// the point was measured after the reference time.
    pub age: Vec<f32>,
    /// M flags: true for points that moved relative to the static world between their sweep and the
    /// reference time, by at least [`crate::flow::DYNAMIC_M`] in some interval. False where the ego
    /// motion is unknown.
    pub dynamic: Vec<bool>,
    /// M flags: false for points for which inverting a motion field did not converge, or a step led
    /// out of the range of valid coordinates. Their positions are unreliable.
    pub converged: Vec<bool>,
}
