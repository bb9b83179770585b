//! Points and rigid transforms.

/// A point or a displacement: x, y, z, in metres unless said otherwise. In a sensor frame x points
/// forward, y left and z up.
pub type Point = [f32; 3];

/// A rigid transform: a rotation, then a translation in metres. An ego motion is given as
/// `target_from_source`, which takes coordinates in the source's frame to the target's frame.
pub type RigidTransform = nalgebra::Isometry3<f64>;

/// Threshold of moving points, metres (Argoverse 2). A point is dynamic if its residual motion in
/// one sweep interval is at least this long.
pub const DYNAMIC_M: f32 = 0.05;

/// `point` transformed by `motion`, computed in double precision.
pub(crate) fn transform_point(motion: &RigidTransform, point: Point) -> Point {
    let moved = motion * nalgebra::Point3::from(point.map(f64::from));
    [moved.x as f32, moved.y as f32, moved.z as f32]
}

/// Squared Euclidean distance, square metres.
#[inline]
pub(crate) fn square_distance(a: Point, b: Point) -> f32 {
    let [x, y, z] = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    x * x + y * y + z * z
}

/// The largest integers that are not above `values`, within `limits`: the lower and the upper one, two
/// integers between -2^31 and 2^31. NaN gives the upper limit.
///
/// A loop over an array, and a sum in place of a conversion, compile to vector instructions on all
/// targets. [`f32::floor`] is a function call on targets without an instruction for it.
#[inline(always)]
pub(crate) fn floors<const N: usize>(values: [f32; N], limits: [f32; 2]) -> [i32; N] {
    /// 1.5 times 2^52. Adding it rounds a number to an integer. The low 32 bits of the sum are that
    /// integer.
    const ROUNDING: f64 = (3_u64 << 51) as f64;
    let [low, high] = limits;
    let mut floors = [0; N];
    for (floor, value) in floors.iter_mut().zip(values) {
        let value = if value < high { value } else { high };
        let value = f64::from(if value > low { value } else { low });
        let sum = value + ROUNDING;
        let is_above = sum - ROUNDING > value;
        *floor = (sum.to_bits() as i32).wrapping_sub(i32::from(is_above));
    }
    floors
}

/// At most `most` of the items, evenly spaced.
pub(crate) fn stride_sample<T: Copy>(all: &[T], most: usize) -> Vec<T> {
    let kept = all.len().min(most);
    (0..kept).map(|i| all[i * all.len() / kept]).collect()
}

/// All `points` transformed by `motion`.
pub(crate) fn transform_points(motion: &RigidTransform, points: &[Point]) -> Vec<Point> {
    points
        .iter()
        .map(|&point| transform_point(motion, point))
        .collect()
}

/// Minimum number of points of each cloud that take part in an estimate; fewer points do not
/// determine a rigid motion.
pub const MIN_POINTS: usize = 3;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_floor_is_that_of_the_library() {
        let values = [
            0.0,
            0.5,
            1.0,
            2.999_999_8,
            8_388_607.5,
            8_388_608.0,
            3e9,
            1e30,
            f32::INFINITY,
        ];
        let limits = [-(1 << 30) as f32, (1 << 30) as f32 - 64.0];
        for value in values
            .into_iter()
            .flat_map(|value| [value, -value, value + 0.25, -value - 0.25])
        {
            let expected = value.floor().clamp(limits[0], limits[1]) as i32;
            assert_eq!(floors([value], limits), [expected], "{value}");
        }
        assert_eq!(floors([f32::NAN, 1.5, -1e-30], [-2.0, 7.0]), [7, 1, -1]);
        let far = (1 << 30) as f32;
        assert_eq!(floors([1e30, -1e30], [-far, far]), [1 << 30, -(1 << 30)]);
    }

    #[test]
    fn some_of_the_points_are_spread_over_all_of_them() {
        let points: Vec<Point> = (0..10).map(|i| [i as f32, 0.0, 0.0]).collect();
        let kept: Vec<f32> = stride_sample(&points, 4)
            .iter()
            .map(|point| point[0])
            .collect();
        assert_eq!(kept, [0.0, 2.0, 5.0, 7.0]);
        assert_eq!(stride_sample(&points, 20), points);
        assert_eq!(stride_sample::<Point>(&[], 5), [[0.0; 3]; 0]);
    }
}
