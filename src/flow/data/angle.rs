//! Angles of directions.

use std::f32::consts::{FRAC_PI_2, PI};

/// Coefficients of the odd polynomial that approximates the arc tangent from 0 to 1: of x, x^3, ..., x^15.
/// Fitted for the least largest error, which is 1.4e-7 in single precision.
const ARC_TANGENT: [f32; 8] = [
    0.999_999_34,
    -0.333_298_6,
    0.199_465_66,
    -0.139_086_29,
    0.096_421_97,
    -0.055_912_327,
    0.021_862_958,
    -0.004_054_567,
];

/// The angle of a direction, -pi to pi, as [`f32::atan2`] gives it to within 1e-6; zero where both are
/// zero. It has the same bits on all machines. It has no branches, so that a loop over an array compiles
/// to vector instructions.
#[inline(always)]
pub(crate) fn atan2(y: f32, x: f32) -> f32 {
    let [along, across] = [x.abs(), y.abs()];
    let is_steep = across > along;
    let larger = if is_steep { across } else { along };
    let smaller = if is_steep { along } else { across };
    let tangent = smaller / larger;
    let square = tangent * tangent;
    let mut sum = 0.0;
    for &coefficient in ARC_TANGENT.iter().rev() {
        sum = sum * square + coefficient;
    }
    let angle = sum * tangent;
    let angle = if is_steep { FRAC_PI_2 - angle } else { angle };
    let angle = if x < 0.0 { PI - angle } else { angle };
    let angle = if y < 0.0 { -angle } else { angle };
    if larger == 0.0 { 0.0 } else { angle }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_of_all_directions_are_those_of_the_standard_library() {
        for step in 0..200_000_i32 {
            let angle = (f64::from(step) / 100_000.0 - 1.0) * std::f64::consts::PI;
            let length = 10_f64.powi(step % 9 - 3);
            let [x, y] = [angle.cos(), angle.sin()].map(|c| (c * length) as f32);
            let exact = f64::from(y).atan2(f64::from(x));
            let off = (f64::from(atan2(y, x)) - exact).abs();
            assert!(off < 1e-6, "{x} {y}: {off}");
        }
        assert_eq!(atan2(0.0, 0.0), 0.0);
        assert_eq!(atan2(0.0, -2.0), PI);
        assert_eq!(atan2(-3.0, 0.0), -FRAC_PI_2);
        assert!(atan2(f32::NAN, 1.0).is_nan());
    }
}
