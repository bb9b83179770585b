//! A rigid motion over the ground: a shift in x and y and a turn about the vertical.
//!
//! Nothing that drives or walks rises or tilts by more than a lidar's noise in a tenth of a second;
//! with heights left free, surfaces follow the scan lines. It must not know what is moved.

use crate::flow::data::Point;

/// A shift, and a turn about a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PlanarMotion {
    /// Metres along x and y.
    pub(super) shift_m: [f32; 2],
    /// Radians about the vertical through `center`.
    pub(super) turn: f32,
    /// Metres.
    pub(super) center: [f32; 2],
}

impl PlanarMotion {
    /// No motion, to be turned about `center`.
    pub(super) fn still(center: [f32; 2]) -> Self {
        Self {
            shift_m: [0.0; 2],
            turn: 0.0,
            center,
        }
    }

    /// This motion, `shift_m` farther.
    pub(super) fn shifted(&self, [x, y]: [f32; 2]) -> Self {
        Self {
            shift_m: [self.shift_m[0] + x, self.shift_m[1] + y],
            ..*self
        }
    }

    /// This motion `times` over, or undone as often where that is negative.
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

    /// Where a point comes to lie.
    #[inline]
    pub(super) fn apply(&self, [x, y, z]: Point) -> Point {
        let (sin, cos) = self.turn.sin_cos();
        let [a, b] = [x - self.center[0], y - self.center[1]];
        [
            self.center[0] + self.shift_m[0] + cos * a - sin * b,
            self.center[1] + self.shift_m[1] + sin * a + cos * b,
            z,
        ]
    }

    /// Where a point came from.
    #[inline]
    pub(super) fn undo(&self, [x, y, z]: Point) -> Point {
        let (sin, cos) = self.turn.sin_cos();
        let a = x - self.center[0] - self.shift_m[0];
        let b = y - self.center[1] - self.shift_m[1];
        [
            self.center[0] + cos * a + sin * b,
            self.center[1] - sin * a + cos * b,
            z,
        ]
    }

    /// How far a point is moved.
    pub(super) fn displacement(&self, point: Point) -> Point {
        let moved = self.apply(point);
        core::array::from_fn(|a| moved[a] - point[a])
    }

    /// Metres that the center is moved.
    pub(super) fn length_m(&self) -> f32 {
        self.shift_m[0].hypot(self.shift_m[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_motion_undone_leads_back() {
        // Single precision at 50 m.
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
