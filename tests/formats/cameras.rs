//! Tests of camera calibrations in every supported form, and of depth images.

use fnsf::flow::RigidTransform;
use fnsf::flow::depth::{DepthImage, MAX_SIDE_PX};
use fnsf::formats::{
    FormatError, KITTI_SIZE_PX, read_camera, read_camera0_from_lidar, read_depth_png,
    write_depth_png,
};
use nalgebra::Point3;
use proptest::prelude::*;

/// Tolerance: calibrations are printed with 13 digits, and rotations are converted to a quaternion.
const PRINTED: f64 = 1e-7;

/// A camera 0.06 m to the right of camera 0. The lidar's x axis points forward. It is 0.3 m behind
/// camera 0 and 0.1 m above it.
const OBJECT: &str = "P0: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 7.000000000000e+02 0 600 54 0 700 180 0.9 0 0 1 0.005
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3

";

const CAM_TO_CAM: &str = "calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.95e-02
S_02: 1.392e+03 5.12e+02
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 700 0 600 0 0 700 180 0 0 0 1 0
S_rect_02: 1.224e+03 3.7e+02
R_rect_02: 1 0 0 0 1 0 0 0 1
P_rect_02: 700 0 600 54 0 700 180 0.9 0 0 1 0.005
";

const VELO_TO_CAM: &str = "calib_time: 15-Mar-2012 11:37:16
R: 0 -1 0 0 0 -1 1 0 0
T: 0 -0.1 -0.3
delta_f: 0 0
";

const JSON: &str = r#"{"width": 1242, "height": 375, "k": [[700, 0, 600], [0, 700, 180], [0, 0, 1]],
    "camera_from_lidar": [[0, -1, 0, 0.072857142857142857], [0, 0, -1, -0.1],
                          [1, 0, 0, -0.295], [0, 0, 0, 1]]}"#;

fn refusal(bytes: &[u8], second: Option<&[u8]>) -> String {
    read_camera(bytes, second).unwrap_err().to_string()
}

fn difference(left: &RigidTransform, right: &RigidTransform) -> f64 {
    let difference = left.to_homogeneous() - right.to_homogeneous();
    difference.abs().max()
}

#[test]
fn kittis_object_calibration_sees_a_point_where_its_projection_puts_it() {
    let camera = read_camera(OBJECT.as_bytes(), None).unwrap();
    assert_eq!([camera.width(), camera.height()], KITTI_SIZE_PX);
    // Ten metres ahead, two to the left, one up. The expected pixel is P2 (x, y, z, 1), computed by
    // hand.
    let [x, y, z] = [-2.0, -1.0 - 0.1, 10.0 - 0.3];
    let depth = z + 0.005;
    let column = (700.0 * x + 600.0 * z + 54.0) / depth;
    let row = (700.0 * y + 180.0 * z + 0.9) / depth;
    let seen = camera.pixel([10.0, 2.0, 1.0]).unwrap();
    assert_eq!(seen.0, f64::round(column) as usize);
    assert_eq!(seen.1, f64::round(row) as usize);
    assert!((f64::from(seen.2) - depth).abs() < 1e-5);
}

#[test]
fn raw_drives_and_tracking_and_json_spell_the_same_camera() {
    let object = read_camera(OBJECT.as_bytes(), None).unwrap();
    let raw = read_camera(CAM_TO_CAM.as_bytes(), Some(VELO_TO_CAM.as_bytes())).unwrap();
    assert_eq!([raw.width(), raw.height()], [1224, 370]);
    let tracking = OBJECT
        .replace("R0_rect:", "R_rect")
        .replace("Tr_velo_to_cam:", "Tr_velo_cam");
    let tracking = read_camera(tracking.as_bytes(), None).unwrap();
    let json = read_camera(JSON.as_bytes(), None).unwrap();
    for other in [raw, tracking, json] {
        assert_eq!(other.intrinsics(), object.intrinsics());
        let off = difference(other.camera_from_lidar(), object.camera_from_lidar());
        assert!(off < 1e-3, "{off}");
    }
    assert!(difference(raw.camera_from_lidar(), object.camera_from_lidar()) < PRINTED);
}

#[test]
fn odometrys_camera_is_rectified_already() {
    let odometry = OBJECT
        .lines()
        .filter(|line| !line.starts_with("R0_rect"))
        .collect::<Vec<_>>()
        .join("\n")
        .replace("Tr_velo_to_cam", "Tr");
    let mount = read_camera0_from_lidar(odometry.as_bytes(), None).unwrap();
    let index = mount * Point3::new(10.0, 2.0, 1.0);
    assert!((index - Point3::new(-2.0, -1.1, 9.7)).norm() < PRINTED);
}

#[test]
fn a_calibration_that_lacks_something_says_what() {
    let text = refusal(CAM_TO_CAM.as_bytes(), None);
    assert!(text.contains("give calib_velo_to_cam.txt too"), "{text}");
    let text = refusal(OBJECT.as_bytes(), Some(VELO_TO_CAM.as_bytes()));
    assert!(text.contains("goes with calib_cam_to_cam.txt"), "{text}");
    let text = refusal(OBJECT.replace("P2", "P1").as_bytes(), None);
    assert!(
        text.contains("lacks the projection of camera 2 (P2 or P_rect_02); it has P0, P1"),
        "{text}"
    );
    let text = refusal(OBJECT.replace("54 0", "nan 0").as_bytes(), None);
    assert!(text.contains("P2 is not 12 finite numbers"), "{text}");
    let text = refusal(OBJECT.replace("0 1 0.005", "0 2 0.005").as_bytes(), None);
    assert!(text.contains("the camera matrix is not"), "{text}");
    let text = refusal(OBJECT.replace("R0_rect: 1", "R0_rect: 2").as_bytes(), None);
    assert!(text.contains("the rectification is not a rigid"), "{text}");
    let raw = CAM_TO_CAM.replace("1.224e+03", "1224.5");
    let text = refusal(raw.as_bytes(), Some(VELO_TO_CAM.as_bytes()));
    assert!(text.contains("S_rect_02 is not a size in pixels"), "{text}");
    let raw = CAM_TO_CAM.replace("1.224e+03", "1e+12");
    let text = refusal(raw.as_bytes(), Some(VELO_TO_CAM.as_bytes()));
    assert!(text.contains("each side must lie between"), "{text}");
    let text = refusal(CAM_TO_CAM.as_bytes(), Some(b"R: 1\n"));
    assert!(text.contains("R is not 9 finite numbers"), "{text}");
}

#[test]
fn a_camera_in_json_is_refused_by_what_is_wrong_with_it() {
    for (from, to, wanted) in [
        ("\"width\": 1242", "\"width\": 0", "0 x 375 pixels"),
        ("\"width\": 1242", "\"width\": -3", "invalid value"),
        ("\"width\": 1242, ", "", "missing field `width`"),
        ("\"width\"", "\"widht\"", "unknown field `widht`"),
        ("[[700, 0,", "[[-700, 0,", "fx of the camera is -700"),
        ("[[700, 0,", "[[700, 1,", "the camera matrix is not"),
        ("[1, 0, 0, -0.295]", "[1, 0, 0, 1e9]", "within 1000 m"),
        (
            "[[0, -1, 0,",
            "[[0, -2, 0,",
            "camera_from_lidar is not a rigid",
        ),
    ] {
        let text = refusal(JSON.replace(from, to).as_bytes(), None);
        assert!(text.contains(wanted), "{text}");
    }
    let text = refusal(&[b' '; (64 << 10) + 1], None);
    assert!(text.contains("65536 are the most"), "{text}");
    assert!(refusal(b"\xff\xfe", None).contains("neither JSON nor"));
    assert!(refusal(b"", None).contains("lacks the lidar's pose"));
}

fn png(image: &DepthImage) -> (Vec<u8>, usize) {
    let mut bytes = Vec::new();
    let dropped = write_depth_png(image, &mut bytes).unwrap();
    (bytes, dropped)
}

#[test]
fn depth_comes_back_to_half_a_step() {
    let metres: Vec<f32> = (0..1000).map(|index| index as f32 * 0.2551).collect();
    let image = DepthImage {
        width: 40,
        height: 25,
        metres,
    };
    let (bytes, dropped) = png(&image);
    assert_eq!(dropped, 0);
    let read = read_depth_png(&bytes).unwrap();
    assert_eq!([read.width, read.height], [40, 25]);
    for (read, written) in read.metres.iter().zip(&image.metres) {
        assert!((read - written).abs() <= 0.5 / 256.0);
    }
    assert_eq!(png(&read).0, bytes);
}

#[test]
fn what_the_format_cannot_hold_is_dropped_and_counted() {
    let image = DepthImage {
        width: 6,
        height: 1,
        metres: vec![255.99, 255.999, 900.0, f32::NAN, 0.0, 0.001],
    };
    let (bytes, dropped) = png(&image);
    assert_eq!(dropped, 3);
    let read = read_depth_png(&bytes).unwrap();
    assert_eq!(read.metres[1..], [0.0; 5]);
    assert!((read.metres[0] - 255.99).abs() <= 0.5 / 256.0);
    let torn = DepthImage { width: 7, ..image };
    let error = write_depth_png(&torn, &mut Vec::new()).unwrap_err();
    assert!(matches!(error, FormatError::RowCount { .. }), "{error}");
}

#[test]
fn pictures_that_hold_no_depth_are_refused() {
    let mut gray = Vec::new();
    let mut encoder = png::Encoder::new(&mut gray, 2, 2);
    encoder.set_color(png::ColorType::Grayscale);
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(&[1, 2, 3, 4]).unwrap();
    writer.finish().unwrap();
    let text = read_depth_png(&gray).unwrap_err().to_string();
    assert!(text.contains("16 bits of gray"), "{text}");
    assert!(read_depth_png(b"ply\n").is_err());
    assert!(read_depth_png(b"").is_err());
}

/// A header of a 16-bit grayscale image of the given size, with its checksum, and no image data.
fn png_header(width: u32, height: u32) -> Vec<u8> {
    let mut chunk = b"IHDR".to_vec();
    chunk.extend(width.to_be_bytes());
    chunk.extend(height.to_be_bytes());
    chunk.extend([16, 0, 0, 0, 0]);
    let mut sum = u32::MAX;
    for byte in &chunk {
        sum ^= u32::from(*byte);
        for _ in 0..8 {
            sum = sum >> 1 ^ if sum & 1 == 1 { 0xedb8_8320 } else { 0 };
        }
    }
    let mut bytes = b"\x89PNG\r\n\x1a\n\0\0\0\x0d".to_vec();
    bytes.extend(chunk);
    bytes.extend((!sum).to_be_bytes());
    bytes.extend(b"\0\0\0\x04IDAT\0\0\0\0\0\0\0\0");
    bytes
}

#[test]
fn a_png_that_declares_a_world_in_a_few_bytes_is_refused_before_it_is_unfolded() {
    for (width, height) in [
        (MAX_SIDE_PX + 1, 1),
        (MAX_SIDE_PX, MAX_SIDE_PX),
        (1, MAX_SIDE_PX + 1),
        (u32::MAX >> 1, u32::MAX >> 1),
    ] {
        let error = read_depth_png(&png_header(width, height)).unwrap_err();
        assert!(
            matches!(
                error,
                FormatError::TooLarge { .. } | FormatError::Malformed { .. }
            ),
            "{error}"
        );
    }
    let text = read_depth_png(&png_header(MAX_SIDE_PX, MAX_SIDE_PX)).unwrap_err();
    assert!(text.to_string().contains("are the most"), "{text}");
}

proptest! {
    #[test]
    fn broken_depth_and_cameras_never_panic(at in 0_usize..4096, byte: u8, keep in 0_usize..4096) {
        let image = DepthImage { width: 16, height: 9, metres: vec![12.5; 144] };
        for mut file in [png(&image).0, OBJECT.as_bytes().to_vec(), JSON.as_bytes().to_vec()] {
            let at = at % file.len();
            file[at] = byte;
            file.truncate(keep % (file.len() + 1));
            let _ = read_depth_png(&file);
            let _ = read_camera(&file, None);
        }
    }
}
