//! nuScenes: the sweeps of the top lidar, by the JSON tables.

use std::collections::HashMap;

use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::dataset::{Dataset, DatasetError};
use crate::flow::RigidTransform;
use crate::label::places::Place;
use crate::label::plan::{Drive, DriveSweep, key_of};

/// The channel of the lidar.
const CHANNEL: &str = "LIDAR_TOP";

#[derive(Deserialize)]
struct Sensor {
    token: String,
    channel: String,
}

#[derive(Deserialize)]
struct Calibrated {
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
struct Scene {
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
    /// Microseconds.
    timestamp: i64,
}

/// The folder of the tables; none where there is none.
pub(super) async fn tables(place: &Place) -> Result<Option<String>, DatasetError> {
    let [folders, _] = place.entries("").await?;
    for folder in folders.into_iter().filter(|name| name.starts_with("v1.0-")) {
        let [_, files] = place.entries(&folder).await?;
        if files.iter().any(|file| file == "sample_data.json") {
            return Ok(Some(folder));
        }
    }
    Ok(None)
}

async fn table<T: DeserializeOwned>(
    place: &Place,
    folder: &str,
    name: &str,
) -> Result<Vec<T>, DatasetError> {
    let file = format!("{folder}/{name}.json");
    let bytes = place.read(&file).await?;
    serde_json::from_slice(&bytes).map_err(|error| DatasetError::Table {
        file: place.uri(&file),
        what: error.to_string(),
    })
}

/// The drives: scenes, by their names.
pub(super) async fn drives(place: &Place) -> Result<Vec<Drive>, DatasetError> {
    let none = || DatasetError::None {
        place: place.uri(""),
        dataset: Dataset::Nuscenes,
        looked_for: "v1.0-*/sample_data.json",
    };
    let folder = tables(place).await?.ok_or_else(none)?;
    let wrong = |what: String| DatasetError::Table {
        file: place.uri(&folder),
        what,
    };
    let sensors: Vec<Sensor> = table(place, &folder, "sensor").await?;
    let lidars: Vec<&str> = sensors
        .iter()
        .filter(|sensor| sensor.channel == CHANNEL)
        .map(|sensor| sensor.token.as_str())
        .collect();
    let calibrated: Vec<Calibrated> = table(place, &folder, "calibrated_sensor").await?;
    let mut mounts = HashMap::new();
    for mount in &calibrated {
        if lidars.contains(&mount.sensor_token.as_str()) {
            let motion = motion(mount.translation, mount.rotation);
            let motion = motion.ok_or_else(|| wrong(format!("{} has no rotation", mount.token)))?;
            mounts.insert(mount.token.as_str(), motion);
        }
    }
    let data: Vec<SampleData> = table(place, &folder, "sample_data").await?;
    let poses: Vec<EgoPose> = table(place, &folder, "ego_pose").await?;
    let poses: HashMap<&str, &EgoPose> = poses
        .iter()
        .map(|pose| (pose.token.as_str(), pose))
        .collect();
    let samples: Vec<Sample> = table(place, &folder, "sample").await?;
    let samples: HashMap<&str, &str> = samples
        .iter()
        .map(|sample| (sample.token.as_str(), sample.scene_token.as_str()))
        .collect();
    let scenes: Vec<Scene> = table(place, &folder, "scene").await?;
    let mut found: HashMap<&str, Vec<(&SampleData, RigidTransform)>> = HashMap::new();
    for row in &data {
        let Some(mount) = mounts.get(row.calibrated_sensor_token.as_str()) else {
            continue;
        };
        let pose = poses.get(row.ego_pose_token.as_str());
        let pose = pose.and_then(|pose| motion(pose.translation, pose.rotation));
        let scene = samples.get(row.sample_token.as_str());
        let known = pose.zip(scene);
        let (pose, scene) =
            known.ok_or_else(|| wrong(format!("{} has no pose or no scene", row.filename)))?;
        found.entry(scene).or_default().push((row, pose * mount));
    }
    let mut drives: Vec<Drive> = Vec::new();
    for scene in &scenes {
        let mut rows = found.remove(scene.token.as_str()).unwrap_or_default();
        rows.sort_by_key(|(row, _)| row.timestamp);
        let sweep = |(row, pose): &(&SampleData, RigidTransform)| DriveSweep {
            uri: place.uri(&row.filename),
            key: row.timestamp.to_string(),
            pose: Some(*pose),
            time_s: Some(row.timestamp as f64 * 1e-6),
        };
        drives.push(Drive {
            name: key_of(&scene.name),
            sweeps: rows.iter().map(sweep).collect(),
        });
    }
    drives.sort_by(|one, other| one.name.cmp(&other.name));
    match drives.iter().any(|drive| drive.pairs() > 0) {
        true => Ok(drives),
        false => Err(none()),
    }
}

/// A motion of a translation and of a rotation w, x, y, z. None where the rotation has no length.
fn motion([x, y, z]: [f64; 3], [w, i, j, k]: [f64; 4]) -> Option<RigidTransform> {
    let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), 0.5)?;
    let translation = Translation3::new(x, y, z);
    let is_finite = translation.vector.iter().all(|value| value.is_finite());
    is_finite.then(|| RigidTransform::from_parts(translation, rotation))
}
