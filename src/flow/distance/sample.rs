//! A sample of a distance transform.

use crate::flow::data::Point;

/// The distance to the target at a point, and its gradient.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sample {
    /// Distance to the target, metres. Outside the grid it is the distance at the nearest position
    /// on the grid's border. NaN if a coordinate of the point is NaN.
    pub distance: f32,
    /// Derivative of `distance` with respect to x, y and z, without a unit. Zero along an axis on
    /// which the point lies outside the grid.
    pub gradient: Point,
}
