//! Tests of bulk labelling of data sets, by how their files lie.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use arrow_array::{ArrayRef, BooleanArray, RecordBatch};
use arrow_ipc::writer::FileWriter;
use fnsf::formats::{
    FlowFormat, FlowTable, read_av2_labels, read_cloud, read_flow, read_pair, write_flow,
};

use super::program::{Ended, fnsf, json};
use super::real_data::real_data;

fn label(folder: &Path, arguments: &[&str]) -> Ended {
    let ended = fnsf(folder, &[&["label"], arguments].concat());
    assert_eq!(ended.code, 0, "{}", ended.stderr);
    ended
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to.parent().expect("a folder")).expect("made");
    fs::copy(from, to).expect("copied");
}

/// Writes the sweeps of a simulated street as rows of four or five float32 into `to`, under the
/// names that `name` gives.
fn bins(folder: &Path, to: &str, sweeps: usize, columns: usize, name: impl Fn(usize) -> String) {
    fs::create_dir_all(folder.join(to)).expect("made");
    for sweep in 0..sweeps {
        let file = format!("street/sweep_{sweep:04}.pcd");
        let bytes = fs::read(folder.join(&file)).expect("written");
        let cloud = read_cloud(&bytes, Some(&file)).expect("a cloud");
        let mut out = Vec::new();
        for point in &cloud.points {
            for column in 0..columns {
                let value = point.get(column).copied().unwrap_or_default();
                out.extend(value.to_le_bytes());
            }
        }
        fs::write(folder.join(to).join(name(sweep)), out).expect("writable");
    }
}

fn street(folder: &Path, sweeps: &str) {
    let size = ["--beams", "16", "--sweeps", sweeps];
    let made = fnsf(folder, &[&["synth", "-o", "street"], &size[..]].concat());
    assert_eq!(made.code, 0, "{}", made.stderr);
}

#[test]
fn kitti_lies_in_folders_of_velodyne() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "3");
    let raw = "raw/2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data";
    bins(folder, raw, 3, 4, |sweep| format!("{sweep:010}.bin"));
    bins(folder, "odometry/sequences/04/velodyne", 3, 4, |sweep| {
        format!("{sweep:06}.bin")
    });
    label(folder, &["kitti:raw", "-o", "a"]);
    let first = folder.join("a/2011_09_26/2011_09_26_drive_0005_sync/0000000000.npz");
    label(folder, &["odometry", "-o", "b"]);
    let second = folder.join("b/sequences/04/000000.npz");
    assert!(fs::read(first).expect("written") == fs::read(second).expect("written"));
    // A label for each point, in the folders of SemanticKITTI.
    label(
        folder,
        &["odometry", "-o", "c", "--layout", "semantickitti"],
    );
    let labels = fs::read(folder.join("c/sequences/04/labels/000000.label")).expect("written");
    let cloud = fs::read(folder.join("odometry/sequences/04/velodyne/000000.bin"));
    assert_eq!(labels.len() / 4, cloud.expect("a sweep").len() / 16);
    let flow = fs::read(folder.join("b/sequences/04/000000.npz")).expect("written");
    let flow = read_flow(&flow, Some("flow.npz")).expect("a flow");
    let (valid, dynamic) = (flow.valid.expect("known"), flow.dynamic.expect("known"));
    let flags = valid.iter().zip(&dynamic);
    for (label, (valid, dynamic)) in labels.chunks(4).zip(flags) {
        let expected = match (valid, dynamic) {
            (false, _) => 0,
            (true, false) => 9,
            (true, true) => 251,
        };
        assert_eq!(label, [expected, 0, 0, 0]);
    }
    assert!(dynamic.contains(&true) && dynamic.contains(&false));
    let none = fnsf(folder, &["label", "av2:raw", "-o", "d"]);
    assert_eq!(none.code, 65);
    assert!(none.stderr.contains("sensors/lidar"), "{}", none.stderr);
}

#[test]
fn nuscenes_lies_in_tables() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    street(folder, "3");
    let time = |sweep: usize| 1_532_402_927_647_951 + 50_000 * sweep;
    bins(folder, "set/sweeps/LIDAR_TOP", 3, 5, |sweep| {
        format!("n015__LIDAR_TOP__{}.pcd.bin", time(sweep))
    });
    let mut data = Vec::new();
    let mut poses = Vec::new();
    for sweep in 0..3 {
        let bytes = fs::read(folder.join(format!("street/pair_{:04}.npz", sweep.min(1))));
        let pair = read_pair(&bytes.expect("written")).expect("a pair");
        let ego = pair.ego.expect("known").inverse();
        let along = if sweep == 0 {
            0.0
        } else {
            sweep as f64 * ego.translation.x
        };
        poses.push(
            serde_json::json!({"token": format!("p{sweep}"), "timestamp": time(sweep),
            "translation": [along, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]}),
        );
        data.push(
            serde_json::json!({"token": format!("d{sweep}"), "sample_token": "s0",
            "ego_pose_token": format!("p{sweep}"), "calibrated_sensor_token": "c0",
            "filename": format!("sweeps/LIDAR_TOP/n015__LIDAR_TOP__{}.pcd.bin", time(sweep)),
            "timestamp": time(sweep), "is_key_frame": sweep == 0}),
        );
        data.push(
            serde_json::json!({"token": format!("k{sweep}"), "sample_token": "s0",
            "ego_pose_token": format!("p{sweep}"), "calibrated_sensor_token": "camera",
            "filename": "samples/CAM_FRONT/x.jpg", "timestamp": time(sweep)}),
        );
    }
    // The tables are in no order.
    data.reverse();
    for (name, rows) in [
        (
            "sensor",
            serde_json::json!([{"token": "l", "channel": "LIDAR_TOP"}, {"token": "c", "channel": "CAM_FRONT"}]),
        ),
        (
            "calibrated_sensor",
            serde_json::json!([
            {"token": "c0", "sensor_token": "l", "translation": [0.0, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]},
            {"token": "camera", "sensor_token": "c", "translation": [0.0, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]}]),
        ),
        ("sample_data", serde_json::Value::Array(data)),
        ("ego_pose", serde_json::Value::Array(poses)),
        (
            "sample",
            serde_json::json!([{"token": "s0", "scene_token": "scene"}]),
        ),
        (
            "scene",
            serde_json::json!([{"token": "scene", "name": "scene-0061"}]),
        ),
    ] {
        let path = folder.join("set/v1.0-mini").join(format!("{name}.json"));
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        fs::write(path, rows.to_string()).expect("writable");
    }
    label(
        folder,
        &[
            "nuscenes:set",
            "-o",
            "labels",
            "--known-poses",
            "--preset",
            "default",
        ],
    );
    let name = format!("labels/scene-0061/{}.npz", time(0));
    let flow = read_flow(&fs::read(folder.join(&name)).expect("written"), Some(&name));
    let clusters = flow.expect("a flow").clusters.expect("clusters");
    assert!(clusters.iter().any(|cluster| cluster.dynamic));
    let report = fs::read_dir(folder.join("labels/_report"))
        .expect("there")
        .count();
    assert_eq!(report, 1);
    // A second version beside it: one of them is to be named.
    let other = folder.join("set/v1.0-trainval");
    fs::create_dir_all(&other).expect("made");
    for file in fs::read_dir(folder.join("set/v1.0-mini")).expect("there") {
        let file = file.expect("a file").path();
        let name = file.file_name().expect("a name");
        fs::copy(&file, other.join(name)).expect("copied");
    }
    let both = fnsf(folder, &["label", "nuscenes:set", "-o", "both"]);
    assert_eq!(both.code, 65);
    let said = "it has v1.0-mini and v1.0-trainval: name the folder of one of them";
    assert!(both.stderr.contains(said), "{}", both.stderr);
    let named = [
        "nuscenes:set/v1.0-trainval",
        "-o",
        "named",
        "--preset",
        "default",
    ];
    label(folder, &named);
    assert!(folder.join("named/scene-0061").is_dir());
    fs::remove_dir_all(other).expect("there");
    fs::write(folder.join("set/v1.0-mini/ego_pose.json"), "[{}]").expect("writable");
    let wrong = fnsf(folder, &["label", "set", "-o", "none"]);
    assert_eq!(wrong.code, 65);
    assert!(
        wrong.stderr.contains("ego_pose.json: missing field"),
        "{}",
        wrong.stderr
    );
}

#[test]
fn the_challenges_of_argoverse_2_get_their_layouts() {
    let Some(data) = real_data() else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let data = data.join("av2_7fab");
    let [first, second] = ["315966265259836000", "315966265360032000"];
    let log = folder.join("av2/7fab");
    for sweep in [first, second] {
        let name = format!("{sweep}.feather");
        copy(&data.join(&name), &log.join("sensors/lidar").join(&name));
    }
    let poses = "city_SE3_egovehicle.feather";
    // Poses that cannot be read matter only where they are asked for.
    fs::write(log.join(poses), "no table").expect("writable");
    label(folder, &["av2:av2", "-o", "estimated"]);
    let known = ["label", "av2:av2", "-o", "known", "--known-poses"];
    let refused = fnsf(folder, &known);
    assert_eq!(refused.code, 2, "{}", refused.stderr);
    assert!(refused.stderr.contains(poses), "{}", refused.stderr);
    copy(&data.join(poses), &log.join(poses));
    let truth = fs::read(data.join("flow_labels.feather")).expect("there");
    let truth = read_av2_labels(&truth).expect("labels");
    // The official masks: within 50 m, off the ground, by the labels' own ground.
    let source = fs::read(data.join(format!("{first}.feather"))).expect("there");
    let source = read_cloud(&source, None).expect("a cloud").points;
    let mask: Vec<bool> = source
        .iter()
        .zip(&truth.ground)
        .map(|(point, ground)| point[0].abs() <= 50.0 && point[1].abs() <= 50.0 && !ground)
        .collect();
    let path = folder.join(format!("masks/7fab/{first}.feather"));
    fs::create_dir_all(path.parent().expect("a folder")).expect("made");
    write_mask(&mask, &path);
    for layout in ["feather", "av2-v1", "av2-v2", "av2-v3"] {
        let mut arguments = vec!["av2:av2", "-o", layout, "--layout", layout, "--known-poses"];
        if layout == "av2-v1" {
            arguments.extend(["--masks", "masks"]);
        }
        label(folder, &arguments);
    }
    let read = |name: &str| {
        let bytes = fs::read(folder.join(name)).expect("written");
        read_flow(&bytes, Some(name)).expect("a flow")
    };
    let whole = read(&format!("feather/7fab/{first}.feather"));
    let [one, two, three] = [
        read(&format!("av2-v1/7fab/{first}.feather")),
        read("av2-v2/7fab/0000000000.feather"),
        read(&format!("av2-v3/7fab/{first}.feather")),
    ];
    let asked = mask.iter().filter(|&&asked| asked).count();
    assert_eq!(
        (one.flow.len(), two.flow.len(), three.flow.len()),
        (asked, source.len(), source.len())
    );
    assert_eq!(one.dynamic.as_ref().map(Vec::len), Some(asked));
    assert_eq!((two.valid.is_some(), two.dynamic.is_some()), (true, false));
    assert_eq!(
        (three.valid.is_some(), three.dynamic.is_some()),
        (false, false)
    );
    // Flow with the ego motion in the first, without it in the others; float16 rounds to 0.05 %.
    let rows: Vec<usize> = (0..source.len()).filter(|&row| mask[row]).collect();
    for (flow, &row) in one.flow.iter().zip(&rows) {
        for (ours, theirs) in flow.iter().zip(whole.flow[row]) {
            assert!(
                (ours - theirs).abs() < 1e-3 + 1e-3 * theirs.abs(),
                "{row} {ours} {theirs}"
            );
        }
    }
    let still = |flow: &[[f32; 3]]| {
        let small = |flow: &&[f32; 3]| flow.iter().all(|value| value.abs() < 0.05);
        flow.iter().filter(small).count() as f64 / flow.len() as f64
    };
    assert!(still(&two.flow) > 0.9 && still(&three.flow) > 0.9);
    assert_eq!(
        fs::read_to_string(folder.join("av2-v2/metadata.json")).expect("written"),
        "{\"Is Supervised?\": false}\n"
    );
    // The score of the float16 rows is that of the whole flow on these rows, to five digits.
    let mut expanded = vec![[0.0; 3]; source.len()];
    for (flow, &row) in one.flow.iter().zip(&rows) {
        expanded[row] = *flow;
    }
    let sweep = format!("av2/7fab/sensors/lidar/{first}.feather");
    let truth = data.join("flow_labels.feather");
    let truth = truth.to_str().expect("a path");
    let score = |flow: &[[f32; 3]], name: &str| {
        let mut bytes = Vec::new();
        let table = FlowTable {
            source: &source,
            flow,
            valid: &mask,
            dynamic: None,
            objects: None,
            ego: None,
        };
        write_flow(FlowFormat::Npz, &table, &mut bytes).expect("written");
        fs::write(folder.join(name), bytes).expect("writable");
        json(
            folder,
            &["eval", name, "--truth", truth, "--source", &sweep, "--json"],
        )["epe"]
            .as_f64()
            .expect("a number")
    };
    let (half, full) = (score(&expanded, "half.npz"), score(&whole.flow, "full.npz"));
    assert!((half - full).abs() < 1e-5, "{half} {full}");
}

/// Writes a mask as Argoverse 2's archive has it: a feather file with the column `mask`.
fn write_mask(mask: &[bool], path: &Path) {
    let column: ArrayRef = Arc::new(BooleanArray::from(mask.to_vec()));
    let batch = RecordBatch::try_from_iter([("mask", column)]).expect("one column");
    let file = fs::File::create(path).expect("writable");
    let mut writer = FileWriter::try_new(file, &batch.schema()).expect("a writer");
    writer.write(&batch).expect("written");
    writer.finish().expect("written");
}
