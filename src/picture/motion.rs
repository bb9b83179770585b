//! The motion that a picture shows, and the displacement at which its colors saturate.

use nalgebra::Point3;

use crate::flow::{Point, RigidTransform};

/// Smallest full scale, metres: a smaller one would show noise in full color.
const LEAST_SCALE_M: f32 = 0.1;

/// Share of the moving points whose displacement is below the full scale; the others saturate.
const COVERED: f64 = 0.98;

/// The displacements to be shown, N x 3 in metres, for N source points and their flow, both in
/// metres.
///
/// With the ego motion (`target_from_source`), its displacement of each point is subtracted, so the
/// motion is relative to the world. Rows past the shorter of `source` and `flow` are then left out.
/// Without it the flow is returned unchanged.
pub fn shown_motion(source: &[Point], flow: &[Point], ego: Option<&RigidTransform>) -> Vec<Point> {
    let Some(ego) = ego else {
        return flow.to_vec();
    };
    let residual = |(point, flow): (&Point, &Point)| {
        let [x, y, z] = point.map(f64::from);
        let rest = ego * Point3::new(x, y, z) - Point3::new(x, y, z);
        [
            flow[0] - rest.x as f32,
            flow[1] - rest.y as f32,
            flow[2] - rest.z as f32,
        ]
    };
    source.iter().zip(flow).map(residual).collect()
}

/// The horizontal displacement at which colors saturate, metres: the smallest of 0.1, 0.15, 0.2,
/// 0.3, 0.4, 0.5, 0.6, 0.8, 1, 1.5, ... that covers 98 % of the moving points.
///
/// `motion` are N displacements, metres, and `valid` N flags: which of them count. Rows past the
/// shorter of the two are left out. Points whose horizontal displacement is NaN or below 0.05 m do
/// not count as moving. Without moving points the result is 0.1 m.
pub fn full_scale(motion: &[Point], valid: &[bool]) -> f32 {
    let mut moving: Vec<f32> = motion
        .iter()
        .zip(valid)
        .filter(|(_, valid)| **valid)
        .map(|(motion, _)| motion[0].hypot(motion[1]))
        .filter(|speed| *speed >= LEAST_SCALE_M / 2.0)
        .collect();
    if moving.is_empty() {
        return LEAST_SCALE_M;
    }
    let index = ((moving.len() - 1) as f64 * COVERED) as usize;
    let (_, speed, _) = moving.select_nth_unstable_by(index, f32::total_cmp);
    round_up(*speed).max(LEAST_SCALE_M)
}

/// The next of the round numbers that [`full_scale`] names.
fn round_up(value: f32) -> f32 {
    let decade = 10.0_f32.powf(value.log10().floor());
    let steps = [1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0].map(|step| step * decade);
    // A small tolerance: rounding of the logarithm must not turn 0.2 m into 0.3 m.
    steps
        .into_iter()
        .find(|step| *step >= value * 0.999)
        .unwrap_or(10.0 * decade)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_at_rest_in_the_world_shows_no_motion() {
        let ego = RigidTransform::new(
            nalgebra::Vector3::new(-1.0, 0.0, 0.0),
            nalgebra::Vector3::new(0.0, 0.0, 0.1),
        );
        let point = [10.0_f32, 5.0, 1.0];
        let moved = ego * Point3::new(10.0, 5.0, 1.0);
        let flow = [
            moved.x as f32 - 10.0,
            moved.y as f32 - 5.0,
            moved.z as f32 - 1.0,
        ];
        let shown = shown_motion(&[point], &[flow], Some(&ego));
        assert!(shown[0].iter().all(|value| value.abs() < 1e-5), "{shown:?}");
    }

    #[test]
    fn the_full_scale_is_a_round_number_that_covers_the_movers() {
        assert_eq!(full_scale(&[], &[]), 0.1);
        assert_eq!(full_scale(&[[0.0, 0.0, 0.0]; 9], &[true; 9]), 0.1);
        assert!((full_scale(&[[1.3, 0.0, 0.0]; 9], &[true; 9]) - 1.5).abs() < 1e-6);
        assert!((full_scale(&[[0.0, 0.2, 9.0]; 9], &[true; 9]) - 0.2).abs() < 1e-6);
        assert_eq!(full_scale(&[[7.0, 0.0, 0.0]; 9], &[false; 9]), 0.1);
    }
}
