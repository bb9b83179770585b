//! Points and rigid transforms: the vocabulary that every other room shares.

/// A point or a displacement: x, y, z in metres (x forward, y left, z up in lidar convention).
pub type Point = [f32; 3];

/// A rigid motion, column vectors, metres. Named `target_from_source` where it is stored.
pub type RigidTransform = nalgebra::Isometry3<f64>;

/// Fewer points than this in a cloud determine no motion.
pub const MIN_POINTS: usize = 3;

/// `point`, moved rigidly.
pub(crate) fn moved(motion: &RigidTransform, point: Point) -> Point {
    let moved = motion * nalgebra::Point3::from(point.map(f64::from));
    [moved.x as f32, moved.y as f32, moved.z as f32]
}
