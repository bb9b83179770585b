//! An object on its way from one sweep to the next: constant velocity and yaw rate.

use nalgebra::Vector3;

use super::track::TrackState;
use crate::flow::data::{OrientedBox, Point, RigidTransform, transform_point};

/// An object at the time of a sweep, in the frame of that sweep.
#[derive(Clone, Debug)]
pub(super) struct Carried {
    /// Some of its points, metres.
    pub(super) points: Vec<Point>,
    /// Its box, metres.
    pub(super) bounds: OrientedBox,
    /// Velocity of its center with the ego motion taken out, m/s.
    pub(super) velocity: Point,
    /// Yaw rate, rad/s.
    pub(super) yaw_rate: f32,
}

impl Carried {
    /// The object `dt_s` seconds later, in the frame of the later sweep. `ego` is the ego motion,
    /// later sweep from earlier sweep.
    pub(super) fn later(&self, ego: &RigidTransform, dt_s: f32) -> Self {
        let turn = self.yaw_rate * dt_s;
        let (sin, cos) = turn.sin_cos();
        let [cx, cy, _] = self.bounds.center;
        let way = self.velocity.map(|v| v * dt_s);
        let carry = |[x, y, z]: Point| {
            let [dx, dy] = [x - cx, y - cy];
            let x = cx + dx * cos - dy * sin + way[0];
            let y = cy + dx * sin + dy * cos + way[1];
            transform_point(ego, [x, y, z + way[2]])
        };
        Self {
            points: self.points.iter().copied().map(carry).collect(),
            bounds: OrientedBox {
                center: carry(self.bounds.center),
                size: self.bounds.size,
                yaw: turned(self.bounds.yaw + turn, ego),
            },
            velocity: rotated(ego, self.velocity),
            yaw_rate: self.yaw_rate,
        }
    }

    /// The object as a predicted state in `sweep`.
    pub(super) fn state(&self, sweep: u32) -> TrackState {
        TrackState {
            sweep,
            bounds: self.bounds,
            velocity: self.velocity,
            yaw_rate: self.yaw_rate,
            points: 0,
            confidence: 0.0,
        }
    }
}

/// `vector` with the rotation of `motion`.
pub(super) fn rotated(motion: &RigidTransform, vector: Point) -> Point {
    let turned = motion.rotation * Vector3::from(vector.map(f64::from));
    [turned.x, turned.y, turned.z].map(|c| c as f32)
}

/// The direction `yaw`, radians, after the rotation of `motion`.
fn turned(yaw: f32, motion: &RigidTransform) -> f32 {
    let (sin, cos) = yaw.sin_cos();
    let [x, y, _] = rotated(motion, [cos, sin, 0.0]);
    y.atan2(x)
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;

    use super::*;

    #[test]
    fn an_object_moves_turns_and_is_seen_from_where_the_vehicle_is_then() {
        let object = Carried {
            points: vec![[11.0, 2.0, 0.5]],
            bounds: OrientedBox {
                center: [10.0, 2.0, 0.0],
                size: [2.0, 1.0, 1.0],
                yaw: 0.0,
            },
            velocity: [5.0, 0.0, 0.0],
            yaw_rate: std::f32::consts::PI,
        };
        // The vehicle has driven 1 m ahead and turned left by a right angle.
        let ego = Isometry3::new(
            Vector3::new(1.0, 0.0, 0.0),
            Vector3::z() * std::f64::consts::FRAC_PI_2,
        )
        .inverse();
        let later = object.later(&ego, 0.5);
        let near = |a: Point, b: Point| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        // In the old frame: the center at (12.5, 2), the point turned by a right angle about it.
        assert!(near(later.bounds.center, [2.0, -11.5, 0.0]), "{later:?}");
        assert!(near(later.points[0], [3.0, -11.5, 0.5]), "{later:?}");
        assert!(near(later.velocity, [0.0, -5.0, 0.0]), "{later:?}");
        assert!(later.bounds.yaw.abs() < 1e-6, "{later:?}");
    }
}
