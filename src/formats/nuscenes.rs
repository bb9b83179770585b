//! nuScenes: scenes with the sweeps of the top lidar and their poses, by the JSON tables of `v1.0-*`.

use std::collections::HashMap;

use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::flow::RigidTransform;
use crate::formats::error::{FileKind, FormatError};

/// Names of the tables that [`read_nuscenes`] takes, without their ending `.json`.
pub const NUSCENES_TABLES: [&str; 6] = [
    "sensor",
    "calibrated_sensor",
    "sample_data",
    "ego_pose",
    "sample",
    "scene",
];

/// The channel of the lidar.
const CHANNEL: &str = "LIDAR_TOP";

/// A scene of nuScenes.
#[derive(Clone, Debug, PartialEq)]
pub struct NuscenesScene {
    /// Its name, such as `scene-0061`.
    pub name: String,
    /// Sweeps of the top lidar, by time.
    pub sweeps: Vec<NuscenesSweep>,
}

/// A sweep of the top lidar.
#[derive(Clone, Debug, PartialEq)]
pub struct NuscenesSweep {
    /// Path of its file in the folder of the data set.
    pub file: String,
    /// Microseconds.
    pub timestamp_us: i64,
    /// From the frame of the lidar to that of the map, metres.
    pub world_from_sensor: RigidTransform,
    /// Token of the sample whose key frame it is. Annotations and results are of samples. None for a
    /// sweep between samples.
    pub sample: Option<String>,
}

#[derive(Deserialize)]
struct Sensor {
    token: String,
    channel: String,
}

#[derive(Deserialize)]
struct CalibratedSensor {
    token: String,
    sensor_token: String,
    translation: [f64; 3],
    rotation: [f64; 4],
}

#[derive(Deserialize)]
struct EgoPose {
    token: String,
    translation: [f64; 3],
    rotation: [f64; 4],
}

#[derive(Deserialize)]
struct SceneRow {
    token: String,
    name: String,
}

#[derive(Deserialize)]
struct Sample {
    token: String,
    scene_token: String,
}

#[derive(Deserialize)]
struct SampleData {
    sample_token: String,
    ego_pose_token: String,
    calibrated_sensor_token: String,
    filename: String,
    timestamp: i64,
    #[serde(default)]
    is_key_frame: bool,
}

/// The scenes of the data set, in the order of their table. `tables` are the files that
/// [`NUSCENES_TABLES`] names, in its order.
///
/// # Errors
/// `Malformed` for a table that is not one, for a sweep without a pose or scene or with a file outside
/// of the data set, and for a rotation or translation that is none.
pub fn read_nuscenes<T: AsRef<[u8]>>(tables: &[T; 6]) -> Result<Vec<NuscenesScene>, FormatError> {
    let [sensors, mounts, data, poses, samples, scenes] = tables.each_ref().map(AsRef::as_ref);
    let sensors: Vec<Sensor> = table(0, sensors)?;
    let lidars: Vec<&str> = sensors
        .iter()
        .filter(|sensor| sensor.channel == CHANNEL)
        .map(|sensor| sensor.token.as_str())
        .collect();
    let rows: Vec<CalibratedSensor> = table(1, mounts)?;
    let mut mounts = HashMap::new();
    for mount in &rows {
        if lidars.contains(&mount.sensor_token.as_str()) {
            let motion = motion(mount.translation, mount.rotation);
            let motion =
                motion.ok_or_else(|| malformed(1, format_args!("{} is no motion", mount.token)))?;
            mounts.insert(mount.token.as_str(), motion);
        }
    }
    let data: Vec<SampleData> = table(2, data)?;
    let poses: Vec<EgoPose> = table(3, poses)?;
    let poses: HashMap<&str, &EgoPose> = poses
        .iter()
        .map(|pose| (pose.token.as_str(), pose))
        .collect();
    let samples: Vec<Sample> = table(4, samples)?;
    let scene_of: HashMap<&str, &str> = samples
        .iter()
        .map(|sample| (sample.token.as_str(), sample.scene_token.as_str()))
        .collect();
    let scenes: Vec<SceneRow> = table(5, scenes)?;
    let mut found: HashMap<&str, Vec<NuscenesSweep>> = HashMap::new();
    for row in data {
        let Some(mount) = mounts.get(row.calibrated_sensor_token.as_str()) else {
            continue;
        };
        let pose = poses.get(row.ego_pose_token.as_str());
        let pose = pose.and_then(|pose| motion(pose.translation, pose.rotation));
        let scene = scene_of.get(row.sample_token.as_str());
        let (pose, scene) = pose.zip(scene).ok_or_else(|| {
            malformed(2, format_args!("{} has no pose or no scene", row.filename))
        })?;
        let mut names = row.filename.split('/');
        if names.any(|name| matches!(name, "" | "." | "..")) {
            let what = format_args!("{} is no file of the data set", row.filename);
            return Err(malformed(2, what));
        }
        found.entry(scene).or_default().push(NuscenesSweep {
            world_from_sensor: pose * mount,
            sample: row.is_key_frame.then_some(row.sample_token),
            file: row.filename,
            timestamp_us: row.timestamp,
        });
    }
    let in_order = |scene: SceneRow| {
        let mut sweeps = found.remove(scene.token.as_str()).unwrap_or_default();
        sweeps.sort_by_key(|sweep| sweep.timestamp_us);
        NuscenesScene {
            name: scene.name,
            sweeps,
        }
    };
    Ok(scenes.into_iter().map(in_order).collect())
}

fn malformed(table: usize, what: impl std::fmt::Display) -> FormatError {
    FileKind::Json.malformed(format!("{}.json: {what}", NUSCENES_TABLES[table]))
}

fn table<T: DeserializeOwned>(index: usize, bytes: &[u8]) -> Result<Vec<T>, FormatError> {
    serde_json::from_slice(bytes).map_err(|error| malformed(index, error))
}

/// A motion of a translation, metres, and of a rotation w, x, y, z. None where the rotation does not have
/// the length 1 or the translation is longer than the way around the earth.
fn motion([x, y, z]: [f64; 3], [w, i, j, k]: [f64; 4]) -> Option<RigidTransform> {
    const ROUND_M: f64 = 4e7;
    const OFF: f64 = 1e-3;
    let rotation = Quaternion::new(w, i, j, k);
    let translation = Translation3::new(x, y, z);
    let is_motion = (rotation.norm() - 1.0).abs() < OFF && translation.vector.amax() <= ROUND_M;
    let rotation = UnitQuaternion::from_quaternion(rotation);
    is_motion.then(|| RigidTransform::from_parts(translation, rotation))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn tables() -> [Value; 6] {
        let data = |token: &str, time: i64, key: bool| {
            json!({"token": token, "sample_token": "s", "ego_pose_token": "p",
                "calibrated_sensor_token": "c", "filename": format!("sweeps/{token}.pcd.bin"),
                "timestamp": time, "is_key_frame": key})
        };
        [
            json!([{"token": "l", "channel": "LIDAR_TOP"}, {"token": "x", "channel": "CAM_FRONT"}]),
            json!([{"token": "c", "sensor_token": "l", "translation": [1, 0, 2], "rotation": [1, 0, 0, 0]}]),
            json!([data("later", 20, false), data("first", 10, true)]),
            // A quarter of a turn to the left.
            json!([{"token": "p", "translation": [100, 200, 0],
                "rotation": [0.5_f64.sqrt(), 0, 0, 0.5_f64.sqrt()]}]),
            json!([{"token": "s", "scene_token": "z"}]),
            json!([{"token": "z", "name": "scene-0061"}]),
        ]
    }

    fn read(tables: [Value; 6]) -> Result<Vec<NuscenesScene>, FormatError> {
        read_nuscenes(&tables.map(|table| table.to_string().into_bytes()))
    }

    #[test]
    fn sweeps_are_in_order_with_the_pose_of_the_lidar_and_the_samples_of_key_frames() {
        let scenes = read(tables()).expect("scenes");
        let [scene] = &scenes[..] else {
            panic!("{} scenes", scenes.len());
        };
        assert_eq!(scene.name, "scene-0061");
        let files: Vec<_> = scene.sweeps.iter().map(|sweep| &sweep.file).collect();
        assert_eq!(files, ["sweeps/first.pcd.bin", "sweeps/later.pcd.bin"]);
        assert_eq!(scene.sweeps[0].sample.as_deref(), Some("s"));
        assert_eq!(scene.sweeps[1].sample, None);
        let place = scene.sweeps[0].world_from_sensor.translation.vector;
        assert!((place - nalgebra::Vector3::new(100.0, 201.0, 2.0)).norm() < 1e-9);
    }

    #[test]
    fn a_table_that_is_damaged_is_named() {
        for (index, rows, said) in [
            (0, json!({}), "sensor.json: invalid type"),
            (3, json!([{}]), "ego_pose.json: missing field"),
            (
                3,
                json!([]),
                "sample_data.json: sweeps/later.pcd.bin has no pose",
            ),
            (4, json!([]), "no pose or no scene"),
        ] {
            let mut tables = tables();
            tables[index] = rows;
            let refused = read(tables).expect_err("a damaged table").to_string();
            assert!(refused.contains(said), "{refused}");
        }
        for file in ["../../private.bin", "/private.bin", "sweeps//a.bin"] {
            let mut tables = tables();
            tables[2][0]["filename"] = json!(file);
            let refused = read(tables).expect_err("another file").to_string();
            assert!(refused.contains("is no file of the data set"), "{refused}");
        }
        for (column, none) in [
            ("rotation", json!([0, 0, 0, 0])),
            ("rotation", json!([1e200, 0, 0, 0])),
            ("translation", json!([1e300, 0, 0])),
        ] {
            let mut tables = tables();
            tables[1][0][column] = none;
            let refused = read(tables).expect_err("no motion").to_string();
            let said = "calibrated_sensor.json: c is no motion";
            assert!(refused.contains(said), "{refused}");
        }
    }
}
