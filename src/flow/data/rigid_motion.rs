//! The rigid motion between points and where they go (Kabsch 1976).

use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::point::{Point, RigidTransform};

/// The rigid motion that is nearest to the displacements of points, in the sense of least squares, and
/// the root mean square of what is left, metres. None for fewer than three points, and for points on one
/// line, which do not determine a motion.
pub fn rigid_motion_between(
    moves: impl Iterator<Item = (Point, Point)> + Clone,
) -> Option<(RigidTransform, f64)> {
    let vector = |point: Point| Vector3::from(point.map(f64::from));
    let both = |(point, moved): (Point, Point)| (vector(point), vector(point) + vector(moved));
    let count = moves.clone().count();
    if count < 3 {
        return None;
    }
    let (mut from, mut to) = (Vector3::zeros(), Vector3::zeros());
    for (point, place) in moves.clone().map(both) {
        from += point;
        to += place;
    }
    let [from, to] = [from, to].map(|sum| sum / count as f64);
    let mut covariance = Matrix3::zeros();
    for (point, place) in moves.clone().map(both) {
        covariance += (place - to) * (point - from).transpose();
    }
    let svd = covariance.svd(true, true);
    let (left, right) = (svd.u?, svd.v_t?);
    // Two directions determine the third. A reflection is none.
    if svd.singular_values[1] <= 1e-9 * svd.singular_values[0] {
        return None;
    }
    let sign = (left.determinant() * right.determinant()).signum();
    let turned = left * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * right;
    let rotation = Rotation3::from_matrix_unchecked(turned);
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    let motion = RigidTransform::from_parts(Translation3::from(to - rotation * from), rotation);
    let apart: f64 = moves
        .map(both)
        .map(|(point, place)| {
            (motion.rotation * point + motion.translation.vector - place).norm_squared()
        })
        .sum();
    Some((motion, (apart / count as f64).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::transform_point;

    fn moves(motion: &RigidTransform, points: &[Point]) -> Vec<(Point, Point)> {
        let displacement = |&point: &Point| {
            let place = transform_point(motion, point);
            let moved = core::array::from_fn(|axis| place[axis] - point[axis]);
            (point, moved)
        };
        points.iter().map(displacement).collect()
    }

    #[test]
    fn a_motion_is_found_again() {
        let rotation = UnitQuaternion::from_euler_angles(0.02, -0.01, 0.3);
        let motion = RigidTransform::from_parts(Translation3::new(1.5, -0.5, 0.1), rotation);
        let points = [
            [1.0, 0.0, 0.0],
            [0.0, 2.0, 0.5],
            [-3.0, 1.0, 0.0],
            [4.0, -2.0, 1.5],
            [9.0, 9.0, -1.0],
        ];
        for count in [3, 5] {
            let moves = moves(&motion, &points[..count]);
            let (found, apart) = rigid_motion_between(moves.into_iter()).expect("a motion");
            assert!((found.translation.vector - motion.translation.vector).norm() < 1e-5);
            assert!(found.rotation.angle_to(&motion.rotation) < 1e-6);
            assert!(apart < 1e-6, "{apart}");
        }
    }

    #[test]
    fn what_is_no_rigid_motion_is_left_over() {
        let points = [
            [1.0, 0.0, 0.0],
            [-1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.0, -1.0, 0.0],
        ];
        // Everything moves away from the middle by 10%.
        let moves = points.map(|point| (point, point.map(|value: f32| 0.1 * value)));
        let (motion, apart) = rigid_motion_between(moves.into_iter()).expect("a motion");
        assert!(motion.translation.vector.norm() < 1e-9 && motion.rotation.angle() < 1e-6);
        assert!((apart - 0.1).abs() < 1e-6, "{apart}");
    }

    #[test]
    fn points_on_a_line_determine_no_motion() {
        let on_a_line = [0.0, 1.0, 2.0, 3.0].map(|x| ([x, 2.0 * x, 0.0], [1.0, 0.0, 0.0]));
        assert_eq!(rigid_motion_between(on_a_line.into_iter()), None);
        assert_eq!(rigid_motion_between(on_a_line.into_iter().take(2)), None);
    }
}
