//! Tests of pose files, and of the ground raster of Argoverse 2.

use fnsf::flow::RigidTransform;
use fnsf::formats::{FormatError, GroundRaster, matrix_rows, read_poses};
use proptest::prelude::*;

use crate::samples::npy;

/// Tolerance of a rotation that is converted to a quaternion and back in float64.
const SAME: f64 = 1e-12;

/// Tolerance of a rotation in float32.
const SINGLE: f64 = 1e-6;

fn pose(index: usize) -> RigidTransform {
    let along = index as f64;
    RigidTransform::new(
        nalgebra::Vector3::new(1.1 * along, 0.02 * along, -0.01),
        nalgebra::Vector3::new(0.001, -0.002, 0.03 * along),
    )
}

fn difference(left: &RigidTransform, right: &RigidTransform) -> f64 {
    (left.to_homogeneous() - right.to_homogeneous()).abs().max()
}

/// The text of `count` poses in KITTI's format.
fn text(count: usize) -> String {
    let line = |index: usize| {
        let rows = matrix_rows(&pose(index));
        let numbers: Vec<String> = rows[..3]
            .as_flattened()
            .iter()
            .map(f64::to_string)
            .collect();
        numbers.join(" ") + "\n"
    };
    (0..count).map(line).collect()
}

fn refusal(bytes: &[u8], sweeps: &[&str]) -> String {
    read_poses(bytes, sweeps).unwrap_err().to_string()
}

#[test]
fn text_and_json_have_a_pose_for_every_frame_in_order() {
    let sweeps = ["b.bin", "a.bin", "c.bin"];
    let json: Vec<String> = (0..3)
        .map(|index| format!("{:?}", matrix_rows(&pose(index))))
        .collect();
    let json = format!(" [{}]", json.join(","));
    for file in [text(3), text(3).replace('\n', " \r\n\n"), json] {
        let poses = read_poses(file.as_bytes(), &sweeps).unwrap();
        assert_eq!(poses.len(), 3);
        for (index, found) in poses.iter().enumerate() {
            assert!(difference(found, &pose(index)) < SAME);
        }
    }
    assert_eq!(read_poses(b"", &[]).unwrap(), []);
}

#[test]
fn frames_of_a_whole_drive_take_the_pose_of_their_number() {
    let sweeps = ["velodyne/000004.bin", "000007.bin"];
    let poses = read_poses(text(10).as_bytes(), &sweeps).unwrap();
    assert!(difference(&poses[0], &pose(4)) < SAME);
    assert!(difference(&poses[1], &pose(7)) < SAME);
    let text = refusal(text(10).as_bytes(), &["000004.bin", "000010.bin"]);
    assert_eq!(text, "the file of poses has 10 rows where 2 are needed");
}

#[test]
fn what_is_no_pose_is_refused_by_line_or_frame() {
    let sweeps = ["a.bin", "b.bin"];
    let short = text(2).replacen(' ', "", 1);
    assert!(refusal(short.as_bytes(), &sweeps).contains("line 1 is not 12 numbers"));
    let long = text(2) + "1";
    assert!(refusal(long.as_bytes(), &sweeps).contains("line 3 is not"));
    let scaled = "1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n";
    let told = refusal(scaled.as_bytes(), &sweeps);
    assert!(told.contains("the pose of b.bin is no rigid"), "{told}");
    let lost = "1 0 0 nan 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 0\n";
    assert!(refusal(lost.as_bytes(), &sweeps).contains("the pose of a.bin"));
    let error = read_poses(text(3).as_bytes(), &sweeps).unwrap_err();
    assert!(matches!(error, FormatError::RowCount { .. }), "{error}");
    assert!(refusal(b"[[1, 2]]", &sweeps).contains("not an array of 4 x 4"));
    assert!(refusal(b"\xff\xff", &sweeps).contains("neither 12 numbers a line"));
}

/// A pose table as in Argoverse 2: time stamps as integers, the rest as float64.
fn av2(times: &[i64], poses: &[RigidTransform]) -> Vec<u8> {
    use arrow_array::{ArrayRef, Float64Array, Int64Array, RecordBatch};
    use std::sync::Arc;
    let float = |value: &dyn Fn(&RigidTransform) -> f64| -> ArrayRef {
        Arc::new(Float64Array::from_iter_values(poses.iter().map(value)))
    };
    let stamps: ArrayRef = Arc::new(Int64Array::from(times.to_vec()));
    let batch = RecordBatch::try_from_iter([
        ("timestamp_ns", stamps),
        ("qw", float(&|pose| pose.rotation.w)),
        ("qx", float(&|pose| pose.rotation.i)),
        ("qy", float(&|pose| pose.rotation.j)),
        ("qz", float(&|pose| pose.rotation.k)),
        ("tx_m", float(&|pose| pose.translation.x)),
        ("ty_m", float(&|pose| pose.translation.y)),
        ("tz_m", float(&|pose| pose.translation.z)),
    ])
    .unwrap();
    written(&batch)
}

fn written(batch: &arrow_array::RecordBatch) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut writer = arrow_ipc::writer::FileWriter::try_new(&mut bytes, &batch.schema()).unwrap();
    writer.write(batch).unwrap();
    writer.finish().unwrap();
    drop(writer);
    bytes
}

#[test]
fn argoverse_poses_are_found_by_time_stamp() {
    let times: Vec<i64> = (0..20)
        .map(|index| 315_966_265_259_836_000 + index * 1000)
        .collect();
    let poses: Vec<RigidTransform> = (0..20).map(pose).collect();
    let file = av2(&times, &poses);
    let sweeps = [
        "lidar/315966265259848000.feather",
        "315966265259839000.feather",
    ];
    let found = read_poses(&file, &sweeps).unwrap();
    assert!(difference(&found[0], &pose(12)) < SINGLE);
    assert!(difference(&found[1], &pose(3)) < SINGLE);
    // As ROS writes times.
    let found = read_poses(&file, &["scan_0315966265.259845000.pcd"]).unwrap();
    assert!(difference(&found[0], &pose(9)) < SINGLE);
    // A clock in nanoseconds that began later has fewer digits than one that began in 1970.
    for time in [1_700_000_000_000, 1_700_000_000_000_000] {
        let late = av2(&[time - 1000, time], &poses[..2]);
        let found = read_poses(&late, &[&format!("{time}.feather")]).unwrap();
        assert!(difference(&found[0], &pose(1)) < SINGLE);
    }
    let told = refusal(&file, &["315966265259800000.feather"]);
    assert!(
        told.contains("lacks a pose at the time of 315966265259800000.feather"),
        "{told}"
    );
    let told = refusal(&file, &["sweep.feather"]);
    assert!(told.contains("not named by one"), "{told}");
    let mut broken = poses;
    broken[3].rotation =
        nalgebra::UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(0.5, 0.0, 0.0, 0.0));
    let told = refusal(&av2(&times, &broken), &sweeps);
    assert!(told.contains("not a rigid transform"), "{told}");
}

#[test]
fn a_table_of_more_poses_than_its_bytes_can_hold_is_refused() {
    use arrow_array::{ArrayRef, BooleanArray, RecordBatch};
    let bits: ArrayRef = std::sync::Arc::new(BooleanArray::from(vec![true; 100_000]));
    let columns = [
        "timestamp_ns",
        "qw",
        "qx",
        "qy",
        "qz",
        "tx_m",
        "ty_m",
        "tz_m",
    ];
    let columns = columns.map(|name| (name, bits.clone()));
    let file = written(&RecordBatch::try_from_iter(columns).unwrap());
    let told = refusal(&file, &["1.feather"]);
    assert!(told.contains("bytes claim 100000 poses"), "{told}");
}

/// Two rows of three cells of half a metre, with the corner at (10, 20). One cell is unknown, one
/// is at 5 m, and the others are at 1 m.
fn raster() -> (Vec<u8>, &'static str) {
    let heights = [1.0, 1.0, f32::NAN, 1.0, 1.0, 5.0_f32];
    let bytes: Vec<u8> = heights
        .iter()
        .flat_map(|height| height.to_le_bytes())
        .collect();
    let similarity = r#"{"R": [1.0, 0.0, 0.0, 1.0], "t": [-10.0, -20.0], "s": 2.0}"#;
    (npy("'<f4'", false, "(2, 3)", &bytes), similarity)
}

#[test]
fn points_near_or_below_the_raster_are_ground() {
    let (heights, similarity) = raster();
    let raster = GroundRaster::read(&heights, similarity.as_bytes()).unwrap();
    let city_from_frame = RigidTransform::translation(10.0, 20.0, 1.0);
    let points = [
        [0.2, 0.2, 0.29],
        [0.2, 0.2, 0.31],
        [0.2, 0.2, -9.0],
        [1.2, 0.2, 0.0], // the unknown cell
        [1.2, 0.7, 4.2], // the higher cell
        [1.6, 0.2, 0.0], // outside the raster
        [0.2, 1.1, 0.0],
        [-0.6, 0.2, 0.0],
        [f32::NAN, 0.2, 0.0],
    ];
    assert_eq!(
        raster.ground(&points, &city_from_frame),
        [true, false, true, false, true, false, false, false, false]
    );
}

#[test]
fn a_raster_of_another_shape_or_without_its_bytes_is_refused() {
    let (heights, similarity) = raster();
    let refused = |heights: &[u8], similarity: &str| {
        let refused = GroundRaster::read(heights, similarity.as_bytes());
        refused.unwrap_err().to_string()
    };
    let short = refused(&heights[..heights.len() - 1], similarity);
    assert!(
        short.contains("needs 24 bytes where 23 are left"),
        "{short}"
    );
    let world = npy("'<f2'", false, "(400000, 400000)", &[0; 8]);
    assert!(refused(&world, similarity).contains("needs"));
    let flat = npy("'|b1'", false, "(3, 1)", &[1, 0, 1]);
    assert!(refused(&flat, similarity).contains("of floats"));
    for similarity in [
        r#"{"R": [2.0, 0.0, 0.0, 1.0], "t": [0, 0], "s": 1}"#,
        r#"{"R": [1.0, 0.0, 0.0, 1.0], "t": [0, 0], "s": 0}"#,
        r#"{"R": [1.0, 0.0, 0.0, 1.0], "t": [0], "s": 1}"#,
        "{}",
    ] {
        assert!(refused(&heights, similarity).starts_with("malformed json"));
    }
}

proptest! {
    #[test]
    fn broken_poses_and_rasters_never_panic(at in 0_usize..4096, byte: u8, keep in 0_usize..4096) {
        let times = [1, 2, 3];
        let table = av2(&times, &times.map(|index| pose(index as usize)));
        let (heights, similarity) = raster();
        let json = format!("[{:?}]", matrix_rows(&pose(1))).into_bytes();
        for mut file in [text(3).into_bytes(), json, table, heights.clone()] {
            let at = at % file.len();
            file[at] = byte;
            file.truncate(keep % (file.len() + 1));
            let _ = read_poses(&file, &["1", "2", "3"]);
            let _ = GroundRaster::read(&file, similarity.as_bytes());
            let _ = GroundRaster::read(&heights, &file);
        }
    }
}
