//! Camera calibration files: this project's JSON, and KITTI's calibration text.
//!
//! For KITTI the camera is the left color camera, number 2, rectified.

use nalgebra::{Matrix3, Vector3};

use super::error::{FileKind, FormatError, shorten};
use super::motion::rigid_motion;
use crate::flow::RigidTransform;
use crate::flow::depth::{Camera, Intrinsics};

const KIND: FileKind = FileKind::Camera;

/// Size limit of a calibration file, bytes. Typical ones have four kilobytes.
const MAX_FILE: usize = 64 << 10;

/// Width and height of KITTI's rectified images, pixels. Used where the calibration does not
/// contain them, as in the object and odometry benchmarks. Some of their images are up to 20 pixels
/// smaller.
pub const KITTI_SIZE_PX: [u32; 2] = [1242, 375];

/// This project's JSON format.
#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    width: u32,
    height: u32,
    k: [[f64; 3]; 3],
    camera_from_lidar: [[f64; 4]; 4],
}

/// Reads a camera. `bytes` is the content of the file; its format is recognized by content.
///
/// - JSON: `{"width": 1242, "height": 375, "k": 3 x 3, "camera_from_lidar": 4 x 4}`. Sizes and `k`
///   are in pixels, the translation in metres, matrices row by row. The camera frame has x right, y
///   down, z forward.
/// - KITTI's object, tracking and odometry calibration: `P2`; `R0_rect` or `R_rect` (none in
///   odometry); `Tr_velo_to_cam`, `Tr_velo_cam` or `Tr`. The size is [`KITTI_SIZE_PX`].
/// - KITTI's raw `calib_cam_to_cam.txt`, with the content of `calib_velo_to_cam.txt` as
///   `velo_to_cam`. The other formats have no second file. The size is `S_rect_02`, or
///   [`KITTI_SIZE_PX`] without it.
///
/// # Errors
/// - `Malformed` for bytes that are not UTF-8 text, JSON without exactly these keys and shapes, and
///   an entry without the required finite numbers. Also for a pose that is not rigid, and a
///   `velo_to_cam` without `R` or `T`.
/// - `Unsupported` where `velo_to_cam` is missing, or is given with another format.
/// - `Missing` where text lacks the projection or the lidar's pose. Text that is no calibration
///   lacks both.
/// - `TooLarge` for a file over 64 KiB.
/// - `Camera` for an image size, a camera matrix or a pose that is invalid or out of range.
pub fn read_camera(bytes: &[u8], velo_to_cam: Option<&[u8]>) -> Result<Camera, FormatError> {
    if bytes.len() <= MAX_FILE && bytes.trim_ascii_start().starts_with(b"{") {
        if velo_to_cam.is_some() {
            return Err(KIND.unsupported("a camera in JSON has its pose; give it alone"));
        }
        let written: Written =
            serde_json::from_slice(bytes).map_err(|error| KIND.malformed(error.to_string()))?;
        return Ok(Camera::new(
            Intrinsics::from_matrix(&written.k)?,
            rigid("camera_from_lidar", &written.camera_from_lidar)?,
            [written.width, written.height],
        )?);
    }
    let calibration = Calibration::open(bytes)?;
    let camera0_from_lidar = calibration.camera0_from_lidar(velo_to_cam)?;
    let [a, b, c, _] = calibration.rows("the projection of camera 2", &["P2", "P_rect_02"])?;
    let matrix = [[a[0], a[1], a[2]], [b[0], b[1], b[2]], [c[0], c[1], c[2]]];
    let intrinsics = Intrinsics::from_matrix(&matrix)?;
    // P is K (I | t): camera 2 is displaced from the rectified camera 0.
    let depth = c[3];
    let beside = Vector3::new(
        (a[3] - intrinsics.cx * depth) / intrinsics.fx,
        (b[3] - intrinsics.cy * depth) / intrinsics.fy,
        depth,
    );
    let camera_from_camera0 = nalgebra::Translation3::from(beside);
    let size = calibration.size()?.unwrap_or(KITTI_SIZE_PX);
    Ok(Camera::new(
        intrinsics,
        camera_from_camera0 * camera0_from_lidar,
        size,
    )?)
}

/// The lidar's pose in the frame of KITTI's rectified camera 0, translation in metres, from KITTI's
/// calibration text. The odometry benchmark's poses are those of this camera. A sweep's own pose is
/// `world_from_camera0 * camera0_from_lidar`. The arguments are those of [`read_camera`].
///
/// # Errors
/// - `Malformed`, `Unsupported` and `TooLarge` as for [`read_camera`] of KITTI's text.
/// - `Missing` where the lidar's pose is missing. A camera in JSON does not contain this pose.
pub fn read_camera0_from_lidar(
    bytes: &[u8],
    velo_to_cam: Option<&[u8]>,
) -> Result<RigidTransform, FormatError> {
    Calibration::open(bytes)?.camera0_from_lidar(velo_to_cam)
}

/// A calibration text: lines of a key and numbers.
struct Calibration<'a> {
    entries: Vec<(&'a str, &'a str)>,
}

impl<'a> Calibration<'a> {
    fn open(bytes: &'a [u8]) -> Result<Self, FormatError> {
        if bytes.len() > MAX_FILE {
            return Err(KIND.too_large(format!("{} bytes, {MAX_FILE} are the most", bytes.len())));
        }
        let text = std::str::from_utf8(bytes)
            .map_err(|_| KIND.malformed("neither JSON nor KITTI's calibration text"))?;
        // Most keys end in a colon; in the tracking benchmark some do not.
        let entry = |line: &'a str| {
            let line = line.trim();
            let (key, numbers) = line.split_once(char::is_whitespace)?;
            Some((key.trim_end_matches(':'), numbers))
        };
        Ok(Self {
            entries: text.lines().filter_map(entry).collect(),
        })
    }

    /// The numbers of the first entry with one of `keys`; `None` where there is none.
    fn numbers<const N: usize>(&self, keys: &[&str]) -> Result<Option<[f64; N]>, FormatError> {
        let Some((key, text)) = self.entries.iter().find(|(key, _)| keys.contains(key)) else {
            return Ok(None);
        };
        let wrong = || KIND.malformed(format!("{} is not {N} finite numbers", shorten(key)));
        let mut numbers = [0.0_f64; N];
        let mut words = text.split_ascii_whitespace();
        for number in &mut numbers {
            let word = words.next().ok_or_else(wrong)?;
            *number = word.parse().map_err(|_| wrong())?;
        }
        if words.next().is_some() || numbers.iter().any(|number| !number.is_finite()) {
            return Err(wrong());
        }
        Ok(Some(numbers))
    }

    /// A required 3 x 4 matrix, completed to 4 x 4 by its last row.
    fn rows(&self, what: &str, keys: &[&str]) -> Result<[[f64; 4]; 4], FormatError> {
        let numbers: [f64; 12] = self.numbers(keys)?.ok_or_else(|| {
            let present = self.entries.iter().map(|(key, _)| shorten(key));
            let present: Vec<String> = present.collect();
            KIND.missing(format!("{what} ({})", keys.join(" or ")), &present)
        })?;
        Ok(with_last_row(&numbers))
    }

    /// Width and height of camera 2's rectified images, pixels.
    fn size(&self) -> Result<Option<[u32; 2]>, FormatError> {
        let Some(size) = self.numbers::<2>(&["S_rect_02"])? else {
            return Ok(None);
        };
        // Sizes over 32 bits saturate in the cast; `Camera::new` refuses them.
        if size.iter().any(|side| side.fract() != 0.0 || *side < 1.0) {
            return Err(KIND.malformed("S_rect_02 is not a size in pixels"));
        }
        Ok(Some(size.map(|side| side as u32)))
    }

    /// The lidar's pose in the frame of the rectified camera 0: `camera0_from_lidar`.
    fn camera0_from_lidar(
        &self,
        velo_to_cam: Option<&[u8]>,
    ) -> Result<RigidTransform, FormatError> {
        let is_raw = self.entries.iter().any(|(key, _)| *key == "R_rect_00");
        let unrectified_from_lidar = match (is_raw, velo_to_cam) {
            (true, Some(bytes)) => Calibration::open(bytes)?.pose()?,
            (true, None) => {
                return Err(KIND.unsupported(
                    "calib_cam_to_cam.txt lacks the lidar's pose; give calib_velo_to_cam.txt too",
                ));
            }
            (false, Some(_)) => {
                return Err(KIND.unsupported(
                    "a second file goes with calib_cam_to_cam.txt, and the first is not that",
                ));
            }
            (false, None) => {
                let keys = ["Tr_velo_to_cam", "Tr_velo_cam", "Tr"];
                rigid("the lidar's pose", &self.rows("the lidar's pose", &keys)?)?
            }
        };
        let rotation = self.numbers::<9>(&["R0_rect", "R_rect_00", "R_rect"])?;
        let Some(rotation) = rotation else {
            // The odometry benchmark's pose is already that of the rectified camera.
            return Ok(unrectified_from_lidar);
        };
        let rectified = rigid("the rectification", &pose_rows(&rotation, &[0.0; 3]))?;
        Ok(rectified * unrectified_from_lidar)
    }

    /// The pose in `calib_velo_to_cam.txt`: R and T.
    fn pose(&self) -> Result<RigidTransform, FormatError> {
        let lacks = || KIND.malformed("calib_velo_to_cam.txt has no R and T");
        let rotation = self.numbers::<9>(&["R"])?.ok_or_else(lacks)?;
        let translation = self.numbers::<3>(&["T"])?.ok_or_else(lacks)?;
        rigid("R with T", &pose_rows(&rotation, &translation))
    }
}

/// Twelve numbers as the first three rows of a 4 x 4 matrix.
pub(super) fn with_last_row(numbers: &[f64; 12]) -> [[f64; 4]; 4] {
    let mut rows = [[0.0; 4]; 4];
    rows[3][3] = 1.0;
    for (index, &number) in numbers.iter().enumerate() {
        rows[index / 4][index % 4] = number;
    }
    rows
}

/// The rigid transform of a matrix; errors call it `what`.
fn rigid(what: &str, rows: &[[f64; 4]; 4]) -> Result<RigidTransform, FormatError> {
    let refuse = |_| KIND.malformed(format!("{what} is not a rigid transform"));
    rigid_motion(rows).map_err(refuse)
}

fn pose_rows(rotation: &[f64; 9], translation: &[f64; 3]) -> [[f64; 4]; 4] {
    let rotation = Matrix3::from_row_slice(rotation);
    let row = |row: usize| {
        let [x, y, z] = [0, 1, 2].map(|column| rotation[(row, column)]);
        [x, y, z, translation[row]]
    };
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}
