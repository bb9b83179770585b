//! Planar rigid motion: a translation in x and y and a rotation about the vertical.
//!
//! Vehicles and pedestrians rise or tilt by less than a lidar's noise in a tenth of a second. With
//! a free height, fitted surfaces follow the scan lines.

use crate::flow::data::Point;

/// A translation, and a rotation about a center.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PlanarMotion {
    /// Translation along x and y, metres.
    pub(super) shift_m: [f32; 2],
    /// Rotation about the vertical through `center`, radians, counterclockwise.
    pub(super) turn: f32,
    /// Center of the rotation, x and y, metres.
    pub(super) center: [f32; 2],
}

impl PlanarMotion {
    /// The zero motion, with the center of rotation `center`.
    pub(super) fn still(center: [f32; 2]) -> Self {
        Self {
            shift_m: [0.0; 2],
            turn: 0.0,
            center,
        }
    }

    /// This motion with a translation of `[x, y]` metres added.
    pub(super) fn shifted(&self, [x, y]: [f32; 2]) -> Self {
        Self {
            shift_m: [self.shift_m[0] + x, self.shift_m[1] + y],
            ..*self
        }
    }

    /// This motion applied `times` times; where `times` is negative, its inverse applied as often.
    pub(super) fn repeated(&self, times: i8) -> Self {
        let mut shift_m = [0.0; 2];
        for _ in 0..times.unsigned_abs() {
            let [x, y] = shift_m;
            shift_m = if times > 0 {
                let (sin, cos) = self.turn.sin_cos();
                [
                    cos * x - sin * y + self.shift_m[0],
                    sin * x + cos * y + self.shift_m[1],
                ]
            } else {
                let (sin, cos) = self.turn.sin_cos();
                let [x, y] = [x - self.shift_m[0], y - self.shift_m[1]];
                [cos * x + sin * y, cos * y - sin * x]
            };
        }
        Self {
            shift_m,
            turn: self.turn * f32::from(times),
            center: self.center,
        }
    }

    /// The motion as a map of many points.
    pub(super) fn map(&self) -> MotionMap {
        MotionMap {
            motion: *self,
            sin_cos: self.turn.sin_cos(),
        }
    }

    /// Position of a point after the motion.
    pub(super) fn apply(&self, point: Point) -> Point {
        self.map().apply(point)
    }

    /// Position of a point before the motion: the inverse of [`Self::apply`].
    pub(super) fn undo(&self, point: Point) -> Point {
        self.map().undo(point)
    }

    /// Displacement of a point, metres.
    pub(super) fn displacement(&self, point: Point) -> Point {
        let moved = self.apply(point);
        core::array::from_fn(|a| moved[a] - point[a])
    }

    /// Displacement of the center, metres.
    pub(super) fn length_m(&self) -> f32 {
        self.shift_m[0].hypot(self.shift_m[1])
    }
}

/// A planar motion with the sine and cosine of its rotation.
#[derive(Clone, Copy, Debug)]
pub(super) struct MotionMap {
    motion: PlanarMotion,
    sin_cos: (f32, f32),
}

impl MotionMap {
    /// Position of a point after the motion.
    #[inline]
    pub(super) fn apply(&self, [x, y, z]: Point) -> Point {
        let PlanarMotion {
            shift_m, center, ..
        } = self.motion;
        let (sin, cos) = self.sin_cos;
        let [a, b] = [x - center[0], y - center[1]];
        [
            center[0] + shift_m[0] + cos * a - sin * b,
            center[1] + shift_m[1] + sin * a + cos * b,
            z,
        ]
    }

    /// Position of a point before the motion.
    #[inline]
    pub(super) fn undo(&self, [x, y, z]: Point) -> Point {
        let PlanarMotion {
            shift_m, center, ..
        } = self.motion;
        let (sin, cos) = self.sin_cos;
        let [a, b] = [x - center[0] - shift_m[0], y - center[1] - shift_m[1]];
        [
            center[0] + cos * a + sin * b,
            center[1] - sin * a + cos * b,
            z,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_undone_leads_back() {
        // Single-precision error at 50 m.
        const TOLERANCE_M: f32 = 2e-5;
        let motion = PlanarMotion {
            shift_m: [1.5, -0.5],
            turn: 0.3,
            center: [40.0, 10.0],
        };
        let point = [42.0, 7.0, -1.0];
        let back = motion.undo(motion.apply(point));
        for axis in 0..3 {
            assert!((back[axis] - point[axis]).abs() < TOLERANCE_M, "{back:?}");
        }
        assert_eq!(
            PlanarMotion::still([3.0, 4.0]).displacement([1.0, 2.0, 3.0]),
            [0.0; 3]
        );
    }
}
