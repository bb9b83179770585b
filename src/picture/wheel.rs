//! The color wheel that is common for flow (Baker et al., Middlebury flow benchmark): hue is
//! direction, saturation is magnitude.

use crate::flow::Point;

/// The color of a row without flow: gray, 8-bit red, green, blue.
pub const INVALID_COLOR: [u8; 3] = [170, 170, 170];

/// Steps from red to yellow, green, cyan, blue, magenta and back to red: finer where the eye
/// distinguishes more hues.
const TRANSITIONS: [usize; 6] = [15, 6, 4, 11, 13, 6];

/// The colors between which the transitions run.
const CORNERS: [[f32; 3]; 7] = [
    [1.0, 0.0, 0.0],
    [1.0, 1.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 1.0, 1.0],
    [0.0, 0.0, 1.0],
    [1.0, 0.0, 1.0],
    [1.0, 0.0, 0.0],
];

/// The color of a horizontal displacement, 8-bit red, green, blue, on the color wheel of the
/// Middlebury flow benchmark (Baker et al. 2011).
///
/// The direction in the x-y plane is the hue: +x is red, and the hue turns counterclockwise over
/// yellow, green, cyan, blue and magenta. The length over `full_scale` (same unit) is the
/// saturation, so zero motion is white. Past the full scale the color darkens by a quarter. With a
/// full scale that is not positive, every motion except zero is past it. A length that is NaN gives
/// [`INVALID_COLOR`]. z is ignored.
pub fn color(flow: Point, full_scale: f32) -> [u8; 3] {
    const PAST_SCALE: f32 = 0.75;
    let saturation = flow[0].hypot(flow[1]) / full_scale.max(f32::MIN_POSITIVE);
    if saturation.is_nan() {
        return INVALID_COLOR;
    }
    let pure = hue(flow[0], flow[1]);
    pure.map(|channel| {
        let channel = if saturation <= 1.0 {
            1.0 - saturation * (1.0 - channel)
        } else {
            channel * PAST_SCALE
        };
        (channel * 255.0).round() as u8
    })
}

/// The pure color of a direction: red is +x, and the hue turns as atan2 does.
fn hue(x: f32, y: f32) -> [f32; 3] {
    let steps: usize = TRANSITIONS.iter().sum();
    let turn = y.atan2(x) / std::f32::consts::TAU;
    let mut position = turn.rem_euclid(1.0) * steps as f32;
    for (transition, ends) in TRANSITIONS.iter().zip(CORNERS.windows(2)) {
        let length = *transition as f32;
        if position <= length {
            let part = position / length;
            return std::array::from_fn(|channel| {
                ends[0][channel] + part * (ends[1][channel] - ends[0][channel])
            });
        }
        position -= length;
    }
    CORNERS[0]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rest_is_white_and_full_speed_forward_is_red() {
        assert_eq!(color([0.0, 0.0, 5.0], 1.0), [255, 255, 255]);
        assert_eq!(color([1.0, 0.0, 0.0], 1.0), [255, 0, 0]);
        assert_eq!(color([0.5, 0.0, 0.0], 1.0), [255, 128, 128]);
    }

    #[test]
    fn the_corners_stand_at_the_transitions() {
        let at = |step: f32| {
            let angle = step / 55.0 * std::f32::consts::TAU;
            color([angle.cos(), angle.sin(), 0.0], 1.0001)
        };
        let near = |found: [u8; 3], wanted: [u8; 3]| {
            found
                .iter()
                .zip(wanted)
                .all(|(found, wanted)| found.abs_diff(wanted) <= 1)
        };
        assert!(near(at(15.0), [255, 255, 0]));
        assert!(near(at(21.0), [0, 255, 0]));
        assert!(near(at(25.0), [0, 255, 255]));
        assert!(near(at(36.0), [0, 0, 255]));
        assert!(near(at(49.0), [255, 0, 255]));
    }

    #[test]
    fn past_the_scale_it_darkens_and_nan_is_gray() {
        assert_eq!(color([9.0, 0.0, 0.0], 1.0), [191, 0, 0]);
        assert_eq!(color([f32::NAN, 0.0, 0.0], 1.0), INVALID_COLOR);
    }
}
