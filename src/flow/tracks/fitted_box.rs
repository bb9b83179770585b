//! Boxes of one size along a track.
//!
//! A lidar sees the sides of an object that face it. The nearest corner of its box is where the
//! points end, the far side is not known, so that boxes of one sweep are too small. All boxes of a
//! track get the size that most sweeps reach, and grow away from the sensor.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use super::track::TrackState;
use crate::flow::data::OrientedBox;

/// Quantile of the sizes of the observed boxes that the track's size is.
const QUANTILE: f32 = 0.8;

/// Gives the boxes of a track's `states` the same size.
pub(super) fn fit(states: &mut [TrackState]) {
    let size = core::array::from_fn(|axis| {
        let observed = states.iter().filter(|state| state.points > 0);
        let mut sizes: Vec<f32> = observed.map(|state| state.bounds.size[axis]).collect();
        sizes.sort_unstable_by(f32::total_cmp);
        let at = QUANTILE * sizes.len().saturating_sub(1) as f32;
        sizes.get(at.round() as usize).copied().unwrap_or(0.0)
    });
    for state in states {
        state.bounds = grown(&state.bounds, size);
    }
}

/// `bounds` with `size`, its faces toward the sensor at the origin kept.
fn grown(bounds: &OrientedBox, size: [f32; 3]) -> OrientedBox {
    let (sin, cos) = bounds.yaw.sin_cos();
    let [x, y, z] = bounds.center;
    // The center along the length and the width.
    let along = [x * cos + y * sin, y * cos - x * sin];
    let [a, b] = core::array::from_fn(|axis| {
        let (center, half) = (along[axis], bounds.size[axis] / 2.0);
        let more = size[axis] / 2.0 - half;
        if center.abs() > half {
            center + center.signum() * more
        } else {
            center
        }
    });
    OrientedBox {
        center: [a * cos - b * sin, a * sin + b * cos, z],
        size,
        yaw: bounds.yaw,
    }
}

/// `bounds` with its length along the side nearest to the direction `heading`, radians.
pub(super) fn headed(bounds: &OrientedBox, heading: f32) -> OrientedBox {
    let quarters = ((heading - bounds.yaw) / FRAC_PI_2).round();
    let yaw = bounds.yaw + quarters * FRAC_PI_2;
    let [length, width, height] = bounds.size;
    let swapped = (quarters as i32) % 2 != 0;
    OrientedBox {
        center: bounds.center,
        size: if swapped {
            [width, length, height]
        } else {
            bounds.size
        },
        yaw: yaw - ((yaw - PI) / TAU).ceil() * TAU,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_get_one_size_and_keep_the_faces_that_are_seen() {
        let state = |center: [f32; 3], length: f32| TrackState {
            bounds: OrientedBox {
                center,
                size: [length, 2.0, 1.5],
                yaw: 0.0,
            },
            points: 50,
            ..TrackState::default()
        };
        // Ahead, behind and beside the sensor: 2, 4 and 4 m of a car are seen.
        let mut states = [
            state([10.0, 0.0, 0.0], 2.0),
            state([-10.0, 0.0, 0.0], 4.0),
            state([1.0, 5.0, 0.0], 4.0),
        ];
        fit(&mut states);
        let centers = states.map(|state| state.bounds.center[0]);
        assert_eq!(centers, [11.0, -10.0, 1.0]);
        assert!(states.iter().all(|s| s.bounds.size == [4.0, 2.0, 1.5]));
    }

    #[test]
    fn the_length_is_the_side_along_the_heading() {
        let bounds = OrientedBox {
            center: [0.0; 3],
            size: [4.0, 2.0, 1.0],
            yaw: 0.1,
        };
        let back = headed(&bounds, 3.1);
        assert!((back.yaw - (0.1 - PI)).abs() < 1e-6 || (back.yaw - (0.1 + PI)).abs() < 1e-6);
        assert_eq!(back.size, bounds.size);
        let across = headed(&bounds, 1.5);
        assert!((across.yaw - (0.1 + FRAC_PI_2)).abs() < 1e-6);
        assert_eq!(across.size, [2.0, 4.0, 1.0]);
        assert_eq!(headed(&bounds, 0.0), bounds);
    }
}
