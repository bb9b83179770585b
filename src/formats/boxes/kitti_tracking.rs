//! KITTI's tracking benchmark: `label_02/0000.txt`, a line for each box that the camera sees.
//!
//! ```text
//! frame track class truncated occluded alpha left top right bottom height width length x y z yaw score
//! ```
//!
//! Angles are in radians, sides of the rectangle in pixels, lengths in metres. The place is the center
//! of the box's lower face in the frame of the rectified camera 0. `yaw` is the rotation about that
//! frame's y axis, which points down. Whether something is truncated or occluded is not known: -1.

use std::f64::consts::PI;
use std::fmt::Write;

use nalgebra::{Point3, Vector3};

use super::layout_file::LayoutFile;
use super::sequence::{BoxSequence, confidence};
use crate::flow::depth::Camera;
use crate::flow::{OrientedBox, RigidTransform};
use crate::formats::error::{FileKind, FormatError};

/// The camera whose images the labels are for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KittiCamera {
    /// The left color camera, number 2.
    pub camera: Camera,
    /// From the lidar's frame to that of the rectified camera 0, metres.
    pub camera0_from_lidar: RigidTransform,
}

/// The labels of a sequence. Sweeps are numbered from 0. Boxes outside the image are left out, as in
/// the benchmark.
///
/// # Errors
/// `Unsupported` for a class that is not one word.
pub(super) fn file(
    sequence: &BoxSequence<'_>,
    kitti: &KittiCamera,
) -> Result<LayoutFile, FormatError> {
    if sequence.class.split_whitespace().count() != 1 {
        return Err(FileKind::Camera.unsupported(format!(
            "a class of KITTI is one word, as Car, and not \"{}\"",
            sequence.class
        )));
    }
    let mut text = String::new();
    for (frame, (_, boxes)) in sequence.by_sweep().enumerate() {
        for (track, state) in boxes {
            let Some([left, top, right, bottom]) = kitti.camera.bounds(&corners(&state.bounds))
            else {
                continue;
            };
            let ([x, y, z], yaw) = kitti.pose(&state.bounds);
            let [length, width, height] = state.bounds.size;
            let observed = within_pi(yaw - x.atan2(z));
            let (id, class, score) = (track.id, sequence.class, confidence(track));
            writeln!(
                text,
                "{frame} {id} {class} -1 -1 {observed:.6} {left:.2} {top:.2} {right:.2} {bottom:.2} \
                 {height:.6} {width:.6} {length:.6} {x:.6} {y:.6} {z:.6} {yaw:.6} {score:.6}"
            )
            .expect("a string takes all text");
        }
    }
    Ok(LayoutFile {
        path: "label_02/0000.txt".to_owned(),
        bytes: text.into_bytes(),
    })
}

/// The corners of a box, lidar frame, metres.
fn corners(bounds: &OrientedBox) -> [[f64; 3]; 8] {
    let (sine, cosine) = f64::from(bounds.yaw).sin_cos();
    core::array::from_fn(|corner| {
        let half = |axis: usize| {
            let side = f64::from(bounds.size[axis]) / 2.0;
            if corner >> axis & 1 == 0 { -side } else { side }
        };
        let [x, y, z] = bounds.center.map(f64::from);
        let (along, across) = (half(0), half(1));
        [
            x + cosine * along - sine * across,
            y + sine * along + cosine * across,
            z + half(2),
        ]
    })
}

/// The same angle in -pi to pi.
fn within_pi(angle: f64) -> f64 {
    angle - 2.0 * PI * (angle / (2.0 * PI)).round()
}

impl KittiCamera {
    /// The center of the box's lower face in the frame of camera 0, metres, and the rotation about y.
    fn pose(&self, bounds: &OrientedBox) -> ([f64; 3], f64) {
        let [x, y, z] = bounds.center.map(f64::from);
        let lowest = Point3::new(x, y, z - f64::from(bounds.size[2]) / 2.0);
        let (sine, cosine) = f64::from(bounds.yaw).sin_cos();
        let ahead = self.camera0_from_lidar * Vector3::new(cosine, sine, 0.0);
        let place = self.camera0_from_lidar * lowest;
        // Without a rotation the length lies along x; a positive one turns z towards x.
        (place.coords.into(), (-ahead.z).atan2(ahead.x))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};

    use super::super::samples::{names, tracks};
    use super::*;
    use crate::flow::depth::Intrinsics;

    /// Camera 0 looks along the lidar's x axis, 0.3 m before and 0.1 m below it. Camera 2 is 0.06 m to
    /// the right of camera 0's place.
    fn kitti() -> KittiCamera {
        let axes = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&axes));
        let shift = |x, y, z| RigidTransform::from_parts(Translation3::new(x, y, z), rotation);
        let intrinsics = Intrinsics {
            fx: 700.0,
            fy: 700.0,
            cx: 600.0,
            cy: 180.0,
        };
        let camera = Camera::new(intrinsics, shift(-0.06, -0.1, -0.3), [1242, 375]);
        KittiCamera {
            camera: camera.expect("a camera"),
            camera0_from_lidar: shift(0.0, -0.1, -0.3),
        }
    }

    fn rows(tracks: &[crate::flow::tracks::Track]) -> Vec<Vec<String>> {
        let names = names();
        let sequence = BoxSequence::new(tracks, &names, "Car").expect("a sequence");
        let file = file(&sequence, &kitti()).expect("a file");
        assert_eq!(file.path, "label_02/0000.txt");
        let text = String::from_utf8(file.bytes).expect("text");
        let words = |line: &str| line.split(' ').map(str::to_owned).collect();
        text.lines().map(words).collect()
    }

    #[test]
    fn a_box_ahead_has_its_place_size_and_rotation_in_the_frame_of_camera_0() {
        let mut tracks = tracks();
        for state in tracks.iter_mut().flat_map(|track| &mut track.states) {
            state.bounds.center[0] += 20.0;
        }
        let rows = rows(&tracks);
        // The hidden box of sweep 1 is predicted, and written.
        let frames: Vec<_> = rows.iter().map(|row| [&*row[0], &*row[1]]).collect();
        assert_eq!(frames, [["0", "1"], ["1", "1"], ["2", "1"], ["2", "4"]]);
        let row = &rows[0];
        assert_eq!(row.len(), 18);
        assert_eq!(row[2..5], ["Car", "-1", "-1"]);
        let number = |column: usize| row[column].parse::<f64>().expect("a number");
        let near = |column: usize, wanted: f64, apart: f64| {
            let found = number(column);
            assert!(
                (found - wanted).abs() <= apart,
                "{column}: {found}, {wanted}"
            );
        };
        // Height, width, length.
        for (column, side) in [(10, 1.5), (11, 1.75), (12, 4.5)] {
            near(column, side, 1e-6);
        }
        // The center is (21, -2, 0.5) in the lidar's frame, and its lower face at z = -0.25.
        for (column, place) in [(13, 2.0), (14, 0.25 - 0.1), (15, 21.0 - 0.3)] {
            near(column, place, 1e-5);
        }
        let yaw = -0.25 - FRAC_PI_2;
        near(16, yaw, 1e-6);
        near(5, yaw - (2.0_f64).atan2(20.7), 1e-5);
        near(17, 0.75, 1e-6);
        // The corners, by the rotation that the devkit of the benchmark makes of the row.
        let (sine, cosine) = yaw.sin_cos();
        let corner = |along: f64, up: f64, across: f64| {
            let x = 2.0 + cosine * along + sine * across - 0.06;
            let z = 20.7 - sine * along + cosine * across;
            [600.0 + 700.0 * x / z, 180.0 + 700.0 * (0.15 - up) / z]
        };
        let mut sides = [f64::MAX, f64::MAX, f64::MIN, f64::MIN];
        for along in [-2.25, 2.25] {
            for across in [-0.875, 0.875] {
                for up in [0.0, 1.5] {
                    let [column, line] = corner(along, up, across);
                    sides = [
                        sides[0].min(column),
                        sides[1].min(line),
                        sides[2].max(column),
                        sides[3].max(line),
                    ];
                }
            }
        }
        for (column, side) in (6..).zip(sides) {
            near(column, side, 0.02);
        }
    }

    #[test]
    fn boxes_behind_and_beside_the_image_are_left_out() {
        let mut tracks = tracks();
        tracks[0].states[0].bounds.center = [-20.0, 0.0, 0.5];
        tracks[0].states[1].bounds.center = [5.0, 40.0, 0.5];
        tracks[0].states[2].bounds.center = [20.0, 0.0, 0.5];
        tracks[1].states[0].bounds.center = [20.0, 60.0, 0.5];
        let rows = rows(&tracks);
        assert_eq!(rows.len(), 1);
        assert_eq!(rows[0][..2], ["2", "1"]);
    }

    #[test]
    fn a_class_of_two_words_is_refused() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "large truck").expect("a sequence");
        let refused = file(&sequence, &kitti())
            .expect_err("two words")
            .to_string();
        assert!(refused.contains("one word"), "{refused}");
    }

    #[test]
    fn angles_are_within_half_a_turn() {
        for (angle, wanted) in [(0.5, 0.5), (4.0, 4.0 - 2.0 * PI), (-4.0, 2.0 * PI - 4.0)] {
            assert!((within_pi(angle) - wanted).abs() < 1e-12);
        }
    }
}
