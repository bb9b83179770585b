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
    /// M: whether the point moved relative to the static world between its sweep and the reference
    /// time.
    pub dynamic: Vec<bool>,
    /// M: false if inverting a flow field did not converge; the point's position is then
    /// unreliable.
    pub converged: Vec<bool>,
}
