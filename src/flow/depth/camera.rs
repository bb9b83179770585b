//! The pinhole camera model.
//!
//! Camera frame: x right, y down, z forward, metres. Whole pixel coordinates are the centers of
//! pixels, counted from 0, as in KITTI and OpenCV.

use nalgebra::{Point3, Vector3};

use crate::flow::data::{Point, RigidTransform};

/// Maximum image width and height, pixels.
pub const MAX_SIDE_PX: u32 = 16_384;

/// Maximum number of pixels of an image; each depth takes four bytes.
const MAX_PIXELS: u64 = 1 << 26;

/// Maximum focal length, and maximum distance of the principal point from the image corner, pixels.
const MAX_FOCAL_PX: f64 = 1e6;

/// Maximum distance from the camera to the lidar, metres.
const MAX_MOUNT_M: f64 = 1e3;

/// Points nearer than this along the optical axis are ignored, metres.
pub(super) const NEAR_M: f64 = 0.1;

/// Tolerance of a quaternion's norm around 1.
const UNIT_TOLERANCE: f64 = 1e-6;

/// Why a camera was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A side is zero or longer than [`MAX_SIDE_PX`], or the image has more than 2^26 pixels.
    #[error(
        "an image of {width} x {height} pixels; each side must lie between 1 and {MAX_SIDE_PX}, and both together make at most {MAX_PIXELS}"
    )]
    Size {
        /// Width, pixels.
        width: u32,
        /// Height, pixels.
        height: u32,
    },
    /// An intrinsic parameter is not finite or out of the range that [`Camera::new`] accepts.
    #[error("{name} of the camera is {value} pixels; {wanted}")]
    Intrinsic {
        /// `fx`, `fy`, `cx` or `cy`.
        name: &'static str,
        /// The rejected value, pixels.
        value: f64,
        /// The accepted range, as text.
        wanted: &'static str,
    },
    /// The 3 x 3 matrix is not of the form fx 0 cx, 0 fy cy, 0 0 1.
    #[error("the camera matrix is not fx 0 cx, 0 fy cy, 0 0 1: rectify skewed or scaled images")]
    Matrix,
    /// The translation is not finite or longer than 1 km, or the rotation is not a unit quaternion.
    #[error("camera_from_lidar is not a rigid transform of finite numbers within {MAX_MOUNT_M} m")]
    Pose,
}

/// Intrinsic parameters of a pinhole camera, in pixels: focal lengths and principal point. A camera
/// point (x, y, z) is seen at column `fx x / z + cx` and row `fy y / z + cy`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Focal length in x (along a row), pixels.
    pub fx: f64,
    /// Focal length in y (along a column), pixels.
    pub fy: f64,
    /// Column of the principal point, pixels; 0 is the center of the first column.
    pub cx: f64,
    /// Row of the principal point, pixels; 0 is the center of the first row.
    pub cy: f64,
}

impl Intrinsics {
    /// The parameters of a 3 x 3 camera matrix `fx 0 cx, 0 fy cy, 0 0 1`, given row by row. Their
    /// values are checked by [`Camera::new`] only.
    ///
    /// # Errors
    /// [`CameraError::Matrix`] if the matrix has another form, such as a skew or a scale.
    pub fn from_matrix(rows: &[[f64; 3]; 3]) -> Result<Self, CameraError> {
        let [[fx, skew, cx], [zero, fy, cy], last] = *rows;
        if skew != 0.0 || zero != 0.0 || last != [0.0, 0.0, 1.0] {
            return Err(CameraError::Matrix);
        }
        Ok(Self { fx, fy, cx, cy })
    }
}

/// A pinhole camera: intrinsic parameters, pose relative to the lidar and image size.
///
/// The camera's frame has x right, y down and z forward, in metres. As in KITTI and OpenCV, whole
/// pixel coordinates are the centers of pixels, counted from 0 at the top left.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    intrinsics: Intrinsics,
    camera_from_lidar: RigidTransform,
    width: u32,
    height: u32,
}

impl Camera {
    /// A camera of `width` x `height` pixels. `camera_from_lidar` transforms points of the lidar's
    /// frame into the camera's: x right, y down, z forward, metres.
    ///
    /// # Errors
    /// - [`CameraError::Size`] if a side is not 1 to [`MAX_SIDE_PX`] pixels, or the image has more
    ///   than 2^26 pixels.
    /// - [`CameraError::Intrinsic`] if a focal length is not a positive number of at most 1e6
    ///   pixels. Also if a coordinate of the principal point is not a number or is larger in
    ///   magnitude than 1e6 pixels.
    /// - [`CameraError::Pose`] if the translation is not finite or longer than 1 km, or the norm of
    ///   the rotation's quaternion is not within 1e-6 of 1.
    pub fn new(
        intrinsics: Intrinsics,
        camera_from_lidar: RigidTransform,
        [width, height]: [u32; 2],
    ) -> Result<Self, CameraError> {
        let sides = 1..=MAX_SIDE_PX;
        let pixels = u64::from(width) * u64::from(height);
        if !sides.contains(&width) || !sides.contains(&height) || pixels > MAX_PIXELS {
            return Err(CameraError::Size { width, height });
        }
        let Intrinsics { fx, fy, cx, cy } = intrinsics;
        for (name, value) in [("fx", fx), ("fy", fy)] {
            if !(value > 0.0 && value <= MAX_FOCAL_PX) {
                return Err(CameraError::Intrinsic {
                    name,
                    value,
                    wanted: "it must be positive and at most 1e6",
                });
            }
        }
        for (name, value) in [("cx", cx), ("cy", cy)] {
            // NaN is rejected, too.
            if !matches!(value.abs(), size if size <= MAX_FOCAL_PX) {
                return Err(CameraError::Intrinsic {
                    name,
                    value,
                    wanted: "it must lie within 1e6 of the image's corner",
                });
            }
        }
        let away = camera_from_lidar.translation.vector.norm();
        let length = camera_from_lidar.rotation.quaternion().norm();
        let is_unit = (length - 1.0).abs() <= UNIT_TOLERANCE;
        if !away.is_finite() || away > MAX_MOUNT_M || !is_unit {
            return Err(CameraError::Pose);
        }
        Ok(Self {
            intrinsics,
            camera_from_lidar,
            width,
            height,
        })
    }

    /// Focal lengths and principal point, pixels.
    pub fn intrinsics(&self) -> Intrinsics {
        self.intrinsics
    }

    /// The transform from the lidar's frame to the camera's, with the translation in metres.
    pub fn camera_from_lidar(&self) -> &RigidTransform {
        &self.camera_from_lidar
    }

    /// Image width, pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Image height, pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// The pixel that a point of the lidar's frame, metres, falls on: its column, its row and the
    /// point's depth. The depth is measured along the optical axis, metres.
    ///
    /// None if the point is not finite, its depth is less than 0.1 m, or it falls outside the
    /// image. Points behind the camera have a negative depth.
    pub fn pixel(&self, point: Point) -> Option<(usize, usize, f32)> {
        let seen = self.camera_from_lidar * Point3::from(point.map(f64::from));
        if !(seen.z >= NEAR_M && seen.z.is_finite()) {
            return None;
        }
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let column = (fx * seen.x / seen.z + cx).round();
        let row = (fy * seen.y / seen.z + cy).round();
        let inside = |value: f64, side: u32| (0.0..f64::from(side)).contains(&value);
        (inside(column, self.width) && inside(row, self.height)).then_some((
            column as usize,
            row as usize,
            seen.z as f32,
        ))
    }

    /// The sides left, top, right and bottom of the rectangle around the projections of a convex
    /// body with these corners, pixels, cut at the image's sides. The corners are in the lidar's
    /// frame, metres. Corners nearer than 0.1 m along the optical axis are taken to that depth.
    ///
    /// None if the rectangle lies outside the image, or all corners lie nearer or behind.
    pub fn bounds(&self, corners: &[[f64; 3]]) -> Option<[f64; 4]> {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let mut sides = [f64::MAX, f64::MAX, f64::MIN, f64::MIN];
        let mut is_ahead = false;
        for &corner in corners {
            let seen = self.camera_from_lidar * Point3::from(corner);
            is_ahead |= seen.z >= NEAR_M;
            let depth = seen.z.max(NEAR_M);
            let (column, row) = (fx * seen.x / depth + cx, fy * seen.y / depth + cy);
            sides = [
                sides[0].min(column),
                sides[1].min(row),
                sides[2].max(column),
                sides[3].max(row),
            ];
        }
        let last = [self.width, self.height].map(|side| f64::from(side - 1));
        let [left, top] = [sides[0].max(0.0), sides[1].max(0.0)];
        let [right, bottom] = [sides[2].min(last[0]), sides[3].min(last[1])];
        (is_ahead && left < right && top < bottom).then_some([left, top, right, bottom])
    }

    /// The ray through the center of a pixel, in the camera's frame, scaled to a depth of 1 m. The
    /// pixel may lie outside the image.
    pub fn ray(&self, column: u32, row: u32) -> Vector3<f64> {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let across = (f64::from(column) - cx) / fx;
        Vector3::new(across, (f64::from(row) - cy) / fy, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLAIN: Intrinsics = Intrinsics {
        fx: 100.0,
        fy: 50.0,
        cx: 20.0,
        cy: 10.0,
    };

    fn camera() -> Camera {
        Camera::new(PLAIN, RigidTransform::identity(), [40, 20]).unwrap()
    }

    #[test]
    fn a_body_is_bounded_by_its_corners_and_cut_at_the_image() {
        let bounds = |corners: &[[f64; 3]]| camera().bounds(corners);
        assert_eq!(
            bounds(&[[-0.5, -0.5, 10.0], [0.5, 1.0, 10.0]]),
            Some([15.0, 7.5, 25.0, 15.0])
        );
        assert_eq!(
            bounds(&[[-9.0, -9.0, 10.0], [0.0, 9.0, 10.0]]),
            Some([0.0, 0.0, 20.0, 19.0])
        );
        assert_eq!(bounds(&[[5.0, 0.0, 10.0], [9.0, 1.0, 10.0]]), None);
        assert_eq!(bounds(&[[-1.0, -1.0, -10.0], [1.0, 1.0, -9.0]]), None);
        assert!(bounds(&[[-1.0, -1.0, -10.0], [1.0, 1.0, 9.0]]).is_some());
    }

    #[test]
    fn a_ray_leads_back_to_its_pixel() {
        for (column, row) in [(0, 0), (39, 19), (20, 10), (7, 3)] {
            let point = camera().ray(column, row) * 12.5;
            let point = [point.x as f32, point.y as f32, point.z as f32];
            let seen = camera().pixel(point).unwrap();
            assert_eq!(seen, (column as usize, row as usize, 12.5));
        }
    }

    #[test]
    fn points_behind_outside_or_nowhere_are_not_seen() {
        for point in [
            [0.0, 0.0, -1.0],
            [0.0, 0.0, 0.0],
            [5.0, 0.0, 1.0],
            [0.0, -9.0, 1.0],
            [f32::NAN, 0.0, 1.0],
            [0.0, 0.0, f32::INFINITY],
        ] {
            assert_eq!(camera().pixel(point), None, "{point:?}");
        }
    }

    #[test]
    fn what_is_no_camera_is_refused() {
        let identity = RigidTransform::identity();
        for size in [[0, 5], [5, 0], [MAX_SIDE_PX + 1, 5], [MAX_SIDE_PX; 2]] {
            let refused = Camera::new(PLAIN, identity, size);
            assert!(matches!(refused, Err(CameraError::Size { .. })), "{size:?}");
        }
        for value in [f64::NAN, f64::INFINITY, 0.0, -1.0] {
            let fx = Intrinsics { fx: value, ..PLAIN };
            assert!(Camera::new(fx, identity, [4, 4]).is_err(), "{value}");
        }
        let cy = Intrinsics {
            cy: f64::NAN,
            ..PLAIN
        };
        let refused = Camera::new(cy, identity, [4, 4]).unwrap_err().to_string();
        assert!(refused.starts_with("cy of the camera"), "{refused}");
        let far = RigidTransform::translation(f64::NAN, 0.0, 0.0);
        assert_eq!(Camera::new(PLAIN, far, [4, 4]), Err(CameraError::Pose));
    }

    #[test]
    fn a_skewed_camera_matrix_is_refused() {
        let plain = [[100.0, 0.0, 20.0], [0.0, 50.0, 10.0], [0.0, 0.0, 1.0]];
        assert_eq!(Intrinsics::from_matrix(&plain), Ok(PLAIN));
        let mut skewed = plain;
        skewed[0][1] = 1.0;
        assert_eq!(Intrinsics::from_matrix(&skewed), Err(CameraError::Matrix));
    }
}
