//! nuScenes: the sweeps of the top lidar, by the JSON tables.

use bytes::Bytes;

use super::dataset::{Dataset, DatasetError};
use crate::formats::{NUSCENES_TABLES, NuscenesScene, NuscenesSweep, read_nuscenes};
use crate::label::places::Place;
use crate::label::plan::{Drive, DriveSweep, key_of};

/// The root of the data set and the folder of its tables. `place` is either of them. None where there
/// are no tables.
///
/// # Errors
/// `Table` where the root has the tables of several versions.
pub(super) async fn tables(place: &Place) -> Result<Option<(Place, String)>, DatasetError> {
    let has_tables = |files: &[String]| files.iter().any(|file| file == "sample_data.json");
    let [folders, files] = place.entries("").await?;
    if has_tables(&files) {
        return Ok(place.parent()?);
    }
    let mut versions: Vec<String> = Vec::new();
    for folder in folders.into_iter().filter(|name| name.starts_with("v1.0-")) {
        let [_, files] = place.entries(&folder).await?;
        if has_tables(&files) {
            versions.push(folder);
        }
    }
    match versions.len() {
        0 | 1 => Ok(versions.pop().map(|version| (place.clone(), version))),
        _ => Err(DatasetError::Table {
            file: place.uri(""),
            what: format!(
                "it has {}: name the folder of one of them",
                versions.join(" and ")
            ),
        }),
    }
}

/// The drives: scenes, by their names.
pub(super) async fn drives(place: &Place) -> Result<Vec<Drive>, DatasetError> {
    let none = || DatasetError::None {
        place: place.uri(""),
        dataset: Dataset::Nuscenes,
        looked_for: "v1.0-*/sample_data.json",
    };
    let (root, folder) = tables(place).await?.ok_or_else(none)?;
    let mut files: [Bytes; NUSCENES_TABLES.len()] = Default::default();
    for (file, name) in files.iter_mut().zip(NUSCENES_TABLES) {
        *file = root.read(&format!("{folder}/{name}.json")).await?;
    }
    let scenes = read_nuscenes(&files).map_err(|error| DatasetError::Table {
        file: root.uri(&folder),
        what: error.to_string(),
    })?;
    let sweep = |sweep: NuscenesSweep| DriveSweep {
        uri: root.uri(&sweep.file),
        key: sweep.timestamp_us.to_string(),
        pose: Some(sweep.world_from_sensor),
        time_s: Some(sweep.timestamp_us as f64 * 1e-6),
    };
    let drive = |scene: NuscenesScene| {
        let sweeps = scene.sweeps.into_iter().map(sweep);
        Drive::new(key_of(&scene.name), sweeps.collect())
    };
    let mut drives: Vec<Drive> = scenes.into_iter().map(drive).collect();
    drives.sort_by(|one, other| one.name.cmp(&other.name));
    match drives.iter().any(|drive| drive.pairs() > 0) {
        true => Ok(drives),
        false => Err(none()),
    }
}
