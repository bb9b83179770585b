//! Sweeps of a sequence, carried into the frame of one of them.
//!
//! It must not know how they were carried there, nor what is made of them.

use super::point::Point;

/// Sweeps carried into one frame: M points, one row each in every list.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DenseCloud {
    /// Where each point is at the instant of the sweep `into`, metres, in that sweep's frame.
    pub points: Vec<Point>,
    /// Place in the sequence of the sweep that measured each point, counted from 0.
    pub frame: Vec<u32>,
    /// `into - frame` in sweeps: positive where the point was measured before, 0 where it belongs
    /// to `into` itself, negative where it was measured after.
    pub age: Vec<f32>,
    /// Whether the point moved against the static world on its way.
    pub dynamic: Vec<bool>,
    /// False where inverting a field did not settle: the point's place is not to be trusted.
    pub converged: Vec<bool>,
}
