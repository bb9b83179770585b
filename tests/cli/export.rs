//! Tests of `fnsf export`.

use std::fs;
use std::path::Path;

use fnsf::formats::{CloudFormat, read_cloud, read_tracks, write_cloud};
use serde_json::{Value, json};

use super::program::fnsf;

/// Simulates a drive of four sweeps, with its tracks.
fn drive(folder: &Path) {
    let size = ["--beams", "8", "--sweeps", "4"];
    let made = fnsf(folder, &[&["synth", "-o", "."], &size[..]].concat());
    assert_eq!(made.code, 0, "{}", made.stderr);
}

fn sweeps() -> [String; 4] {
    [0, 1, 2, 3].map(|sweep| format!("sweep_{sweep:04}.pcd"))
}

fn read_json(path: &Path) -> Value {
    let bytes = fs::read(path).expect("a file");
    serde_json::from_slice(&bytes).expect("JSON")
}

#[test]
fn tracks_become_a_project_of_each_tool_with_the_clouds_beside() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drive(folder);
    let tracks = fs::read(folder.join("tracks.json")).expect("tracks");
    let tracks = read_tracks(&tracks).expect("tracks");
    let boxes: usize = tracks.iter().map(|track| track.states.len()).sum();
    // A sweep of another format is converted.
    let cloud = fs::read(folder.join("sweep_0003.pcd")).expect("a sweep");
    let cloud = read_cloud(&cloud, None).expect("a sweep").points;
    let mut npy = Vec::new();
    write_cloud(CloudFormat::Npy, &cloud, &mut npy).expect("written");
    fs::write(folder.join("sweep_0003.npy"), npy).expect("written");
    let mut sweeps = sweeps();
    sweeps[3] = "sweep_0003.npy".to_owned();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    for (layout, clouds) in [
        ("supervisely", "ds0/pointcloud"),
        ("cvat", "ds0/pointcloud"),
        ("sustechpoints", "lidar"),
    ] {
        let options = ["--layout", layout, "-o", layout, "--class", "Car"];
        let done = fnsf(
            folder,
            &[&["export", "tracks.json"], &sweeps[..], &options].concat(),
        );
        assert_eq!(done.code, 0, "{}", done.stderr);
        let said = format!(
            "{} tracks, {boxes} boxes in 4 sweeps, 4 clouds",
            tracks.len()
        );
        assert!(done.stdout.starts_with(&said), "{}", done.stdout);
        let clouds = folder.join(layout).join(clouds);
        let copied = fs::read(clouds.join("sweep_0000.pcd")).expect("a cloud");
        assert!(copied == fs::read(folder.join("sweep_0000.pcd")).expect("a sweep"));
        let converted = fs::read(clouds.join("sweep_0003.pcd")).expect("a cloud");
        assert!(read_cloud(&converted, None).expect("a cloud").points == cloud);
    }
    let episode = read_json(&folder.join("supervisely/ds0/annotation.json"));
    assert_eq!(
        episode["objects"].as_array().map(Vec::len),
        Some(tracks.len())
    );
    assert_eq!(episode["objects"][0]["classTitle"], "Car");
    let figures = |sweep: &Value| sweep["figures"].as_array().map_or(0, Vec::len);
    let frames = episode["frames"].as_array().expect("frames");
    assert_eq!(frames.iter().map(figures).sum::<usize>(), boxes);
    let cloud = read_json(&folder.join("cvat/ds0/ann/sweep_0002.pcd.json"));
    assert_eq!(figures(&cloud), figures(&frames[2]));
    let labels = read_json(&folder.join("sustechpoints/label/sweep_0002.json"));
    assert_eq!(labels.as_array().map(Vec::len), Some(figures(&frames[2])));
}

#[test]
fn sweeps_that_are_named_by_their_times_become_annotations_of_argoverse_2() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drive(folder);
    let sweeps = sweeps();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let options = ["--layout", "av2", "-o", "av2"];
    let refused = fnsf(
        folder,
        &[&["export", "tracks.json"], &sweeps[..], &options].concat(),
    );
    assert_eq!(refused.code, 65);
    assert!(
        refused.stderr.contains("by their nanoseconds"),
        "{}",
        refused.stderr
    );
    let named: Vec<String> = (0..4)
        .map(|sweep| format!("31596626{sweep}359836000.pcd"))
        .collect();
    for (from, to) in sweeps.iter().zip(&named) {
        fs::rename(folder.join(from), folder.join(to)).expect("renamed");
    }
    let named: Vec<&str> = named.iter().map(String::as_str).collect();
    let done = fnsf(
        folder,
        &[&["export", "tracks.json"], &named[..], &options].concat(),
    );
    assert_eq!(done.code, 0, "{}", done.stderr);
    let written = fs::read(folder.join("av2/annotations.feather")).expect("annotations");
    assert!(written.starts_with(b"ARROW1"));
}

#[test]
fn boxes_that_a_camera_sees_become_labels_of_kittis_tracking_benchmark() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drive(folder);
    // The camera looks along the lidar's x axis.
    fs::write(
        folder.join("calib.txt"),
        "P2: 700 0 600 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n\
         Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n",
    )
    .expect("written");
    let sweeps = sweeps();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let export = |options: &[&str]| {
        let all = [&["export", "tracks.json"], &sweeps[..], options].concat();
        fnsf(folder, &all)
    };
    let kitti = ["--layout", "kitti-tracking", "-o", "kitti"];
    let camera = ["--camera", "calib.txt"];
    let done = export(&[&kitti[..], &camera, &["--class", "Car"]].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    let labels = fs::read_to_string(folder.join("kitti/label_02/0000.txt")).expect("labels");
    let said = format!("{} of them in the image", labels.lines().count());
    assert!(done.stdout.contains(&said), "{}", done.stdout);
    let tracks = fs::read(folder.join("tracks.json")).expect("tracks");
    let tracks = read_tracks(&tracks).expect("tracks");
    let mut seen = 0;
    for line in labels.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        assert_eq!((words.len(), words[2]), (18, "Car"));
        let track = tracks.iter().find(|track| track.id.to_string() == words[1]);
        let mut states = track.expect("a track").states.iter();
        let state = states.find(|state| state.sweep.to_string() == words[0]);
        let bounds = &state.expect("a state").bounds;
        let number = |column: usize| words[column].parse::<f32>().expect("a number");
        let [x, y, z] = bounds.center;
        let place = [-y, -(z - bounds.size[2] / 2.0), x];
        for (axis, place) in place.into_iter().enumerate() {
            assert!((number(13 + axis) - place).abs() < 1e-4, "{line}");
        }
        // The camera is far from all boxes, and its image is narrower than a right angle.
        assert!(x > 0.0 && y.abs() < x + bounds.size[0], "{line}");
        seen += 1;
    }
    assert!(seen > 0, "the street has movers ahead");

    let refused = export(&kitti);
    assert_eq!(refused.code, 2);
    assert!(
        refused.stderr.contains("needs --camera"),
        "{}",
        refused.stderr
    );
    let refused = export(&[&["--layout", "cvat", "-o", "cvat"], &camera[..]].concat());
    assert_eq!(refused.code, 2);
    let refused = export(&[&kitti[..], &camera, &["--class", "large truck"]].concat());
    assert_eq!(refused.code, 65);
    assert!(refused.stderr.contains("one word"), "{}", refused.stderr);
}

/// Tables of nuScenes with the four sweeps; every second is a key frame. The lidar is 10 m ahead of
/// the vehicle, and that 10 m ahead of the map's origin.
fn nuscenes_tables(folder: &Path) {
    let place = json!({"translation": [10, 0, 0], "rotation": [1, 0, 0, 0]});
    let row = |rest: Value| {
        let mut row = place.clone();
        let object = row.as_object_mut().expect("an object");
        object.extend(rest.as_object().expect("an object").clone());
        row
    };
    let data = (0..4).map(|sweep| {
        json!({"token": format!("d{sweep}"), "sample_token": format!("s{}", sweep / 2),
            "ego_pose_token": "p", "calibrated_sensor_token": "c", "is_key_frame": sweep % 2 == 0,
            "filename": format!("sweeps/LIDAR_TOP/sweep_{sweep:04}.pcd"), "timestamp": sweep})
    });
    for (name, rows) in [
        ("sensor", json!([{"token": "l", "channel": "LIDAR_TOP"}])),
        (
            "calibrated_sensor",
            json!([row(json!({"token": "c", "sensor_token": "l"}))]),
        ),
        ("sample_data", data.collect()),
        ("ego_pose", json!([row(json!({"token": "p"}))])),
        (
            "sample",
            json!([{"token": "s0", "scene_token": "z"}, {"token": "s1", "scene_token": "z"}]),
        ),
        ("scene", json!([{"token": "z", "name": "scene-0061"}])),
    ] {
        let path = folder.join("v1.0-mini").join(format!("{name}.json"));
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        fs::write(path, rows.to_string()).expect("written");
    }
}

#[test]
fn boxes_of_key_frames_become_results_of_nuscenes_and_all_of_them_tracklets_of_kitti() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drive(folder);
    nuscenes_tables(folder);
    let sweeps = sweeps();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let export = |options: &[&str]| {
        let all = [&["export", "tracks.json"], &sweeps[..], options].concat();
        fnsf(folder, &all)
    };
    let tracks = fs::read(folder.join("tracks.json")).expect("tracks");
    let tracks = read_tracks(&tracks).expect("tracks");
    let nuscenes = ["--layout", "nuscenes-tracking", "-o", "results"];
    let tables = ["--tables", "v1.0-mini"];
    let done = export(&[&nuscenes[..], &tables, &["--class", "car"]].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    let results = read_json(&folder.join("results/tracking.json"));
    for (sample, sweep) in [("s0", 0), ("s1", 2)] {
        let boxes = results["results"][sample].as_array().expect("boxes");
        let in_sweep = tracks.iter().filter_map(|track| {
            let state = track.states.iter().find(|state| state.sweep == sweep)?;
            Some((track.id.to_string(), state))
        });
        let in_sweep: Vec<_> = in_sweep.collect();
        assert_eq!(boxes.len(), in_sweep.len());
        for (found, (id, state)) in boxes.iter().zip(&in_sweep) {
            assert_eq!(found["tracking_id"], **id);
            let along = found["translation"][0].as_f64().expect("a number");
            assert!((along - f64::from(state.bounds.center[0]) - 20.0).abs() < 1e-6);
        }
    }
    for (options, code, said) in [
        (&nuscenes[..], 2, "needs --tables"),
        (&[&nuscenes[..], &tables].concat(), 65, "tracks the classes"),
        (
            &[&nuscenes[..], &["--tables", "nowhere"]].concat(),
            65,
            "nowhere/sensor.json",
        ),
    ] {
        let refused = export(options);
        assert_eq!(refused.code, code, "{}", refused.stderr);
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }

    let done = export(&["--layout", "kitti-tracklets", "-o", "raw"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    let text = fs::read_to_string(folder.join("raw/tracklet_labels.xml")).expect("tracklets");
    let states = tracks.iter().map(|track| track.states.len());
    assert_eq!(text.matches("<tx>").count(), states.sum::<usize>());
    assert_eq!(text.matches("<objectType>mover<").count(), tracks.len());
    let refused = export(&[&["--layout", "kitti-tracklets", "-o", "raw"], &tables[..]].concat());
    assert_eq!(refused.code, 2);
}

#[test]
fn a_sequence_becomes_one_recording_with_the_motion_of_the_sensor_where_poses_are_given() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drive(folder);
    let sweeps = sweeps();
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let export = |options: &[&str]| {
        let all = [&["export", "tracks.json"], &sweeps[..], options].concat();
        fnsf(folder, &all)
    };
    let done = export(&["--layout", "mcap", "-o", "scene"]);
    assert_eq!(done.code, 0, "{}", done.stderr);
    assert!(
        done.stdout.contains("in 4 sweeps, 4 clouds"),
        "{}",
        done.stdout
    );
    let still = fs::read(folder.join("scene/scene.mcap")).expect("a recording");
    let has = |recording: &[u8], text: &str| {
        let text = text.as_bytes();
        recording.windows(text.len()).any(|at| at == text)
    };
    assert!(has(&still, "/objects") && !has(&still, "/tf"));
    fs::write(
        folder.join("poses.txt"),
        "1 0 0 2 0 1 0 0 0 0 1 0\n".repeat(4),
    )
    .expect("poses");
    let poses = ["--poses", "poses.txt"];
    let done = export(&[&["--layout", "mcap", "-o", "moved"], &poses[..]].concat());
    assert_eq!(done.code, 0, "{}", done.stderr);
    let moved = fs::read(folder.join("moved/scene.mcap")).expect("a recording");
    assert!(has(&moved, "/tf"));
    // It is a recording, though not one of a robot.
    let none = fnsf(folder, &["unpack", "moved/scene.mcap", "--list"]);
    assert!(
        none.stderr.contains("no clouds of sensor_msgs/PointCloud2"),
        "{}",
        none.stderr
    );

    let refused = export(&[&["--layout", "cvat", "-o", "cvat"], &poses[..]].concat());
    assert_eq!(refused.code, 2);
    fs::write(folder.join("sweep_0002.pcd"), "no cloud").expect("written");
    let refused = export(&["--layout", "mcap", "-o", "damaged"]);
    assert_eq!(refused.code, 65);
    assert!(
        refused.stderr.contains("sweep_0002.pcd"),
        "{}",
        refused.stderr
    );
    assert!(!folder.join("damaged/scene.mcap").exists());
}

#[test]
fn tracks_of_another_sequence_and_sweeps_of_one_name_are_refused_before_anything_is_written() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drive(folder);
    let [one, two, three, _] = sweeps();
    for (sweeps, said) in [
        (
            [&one, &two, &three],
            "of 3 given sweeps the last is sweep 2",
        ),
        ([&one, &two, &one], "two sweeps have the name sweep_0000"),
    ] {
        let sweeps = sweeps.map(String::as_str);
        let options = ["--layout", "cvat", "-o", "out"];
        let refused = fnsf(
            folder,
            &[&["export", "tracks.json"], &sweeps[..], &options].concat(),
        );
        assert_eq!(refused.code, 65, "{}", refused.stderr);
        assert!(refused.stderr.contains(said), "{}", refused.stderr);
    }
    assert!(!folder.join("out").exists());
}

#[test]
fn no_input_is_written_over_and_a_cloud_in_its_place_stays() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    drive(folder);
    fs::create_dir(folder.join("lidar")).expect("a folder");
    let sweeps = sweeps().map(|sweep| {
        let place = format!("lidar/{sweep}");
        fs::rename(folder.join(sweep), folder.join(&place)).expect("moved");
        place
    });
    let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
    let before = fs::metadata(folder.join(sweeps[0])).expect("a sweep");
    let options = ["--layout", "sustechpoints", "-o", ".", "--class", "Car"];
    let export = |tracks: &str, options: &[&str]| {
        fnsf(
            folder,
            &[&["export", tracks], &sweeps[..], options].concat(),
        )
    };
    let done = export("tracks.json", &options);
    assert_eq!(done.code, 0, "{}", done.stderr);
    let after = fs::metadata(folder.join(sweeps[0])).expect("a sweep");
    assert_eq!(
        before.modified().expect("a time"),
        after.modified().expect("a time")
    );
    // The recording would have the name of the tracks.
    fs::rename(folder.join("tracks.json"), folder.join("scene.mcap")).expect("moved");
    let tracks = fs::read(folder.join("scene.mcap")).expect("tracks");
    let done = export(
        "scene.mcap",
        &["--layout", "mcap", "-o", ".", "--class", "Car"],
    );
    assert_eq!(done.code, 2, "{}", done.stderr);
    assert!(done.stderr.contains("written over"), "{}", done.stderr);
    assert_eq!(fs::read(folder.join("scene.mcap")).expect("tracks"), tracks);
}

#[test]
fn boxes_beside_points_that_have_times_come_with_a_warning() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    for (rolling, has_times) in [(&[][..], false), (&["--rolling"], true)] {
        let size = ["synth", "-o", ".", "--beams", "8", "--sweeps", "4"];
        let made = fnsf(folder, &[&size[..], rolling].concat());
        assert_eq!(made.code, 0, "{}", made.stderr);
        let sweeps = sweeps();
        let sweeps: Vec<&str> = sweeps.iter().map(String::as_str).collect();
        let options = ["--layout", "supervisely", "-o", "project"];
        let done = fnsf(
            folder,
            &[&["export", "tracks.json"], &sweeps[..], &options].concat(),
        );
        assert_eq!(done.code, 0, "{}", done.stderr);
        let warned = done.stderr.contains("--ignore-times");
        assert_eq!(warned, has_times, "{}", done.stderr);
    }
}
