//! Drives that are folders of sweeps.

use std::collections::HashSet;

use super::dataset::{Dataset, DatasetError};
use crate::formats::{compare_names, read_poses};
use crate::label::layout::SETTINGS_FILE;
use crate::label::places::{Place, PlaceError};
use crate::label::plan::{Drive, DriveSweep, below, drive_name, key_of, stem};

/// Endings of sweeps.
const ENDINGS: [&str; 6] = [".pcd", ".ply", ".bin", ".npy", ".feather", ".las"];
/// The deepest folder that is looked into.
const MAX_DEPTH: usize = 12;
/// What a file system keeps for itself.
const LOST: &str = "lost+found";
/// Where sweeps lie below a log of Argoverse 2.
const AV2_SWEEPS: &str = "sensors/lidar";
/// Where sweeps lie below a drive of KITTI.
const KITTI_SWEEPS: [&str; 2] = ["velodyne_points/data", "velodyne"];

/// Whether a folder is one of those that a data set keeps its sweeps in.
fn is_asked_for(folder: &str, dataset: Dataset) -> bool {
    let ends = |end: &str| folder == end || folder.ends_with(&format!("/{end}"));
    match dataset {
        Dataset::Argoverse2 => ends(AV2_SWEEPS),
        Dataset::Kitti => KITTI_SWEEPS.into_iter().any(ends) || folder.contains("velodyne/"),
        Dataset::Folders | Dataset::Nuscenes => true,
    }
}

/// The name of a drive: its folder, without the part that every drive of its data set has.
fn name(folder: &str) -> String {
    let ends = [AV2_SWEEPS, KITTI_SWEEPS[0], KITTI_SWEEPS[1]];
    let bare = ends.into_iter().find_map(|end| folder.strip_suffix(end));
    let bare = bare.filter(|bare| bare.is_empty() || bare.ends_with('/'));
    drive_name(bare.unwrap_or(folder))
}

/// Whether a folder with settings is the output of a run, which may lie below its input.
async fn is_output(place: &Place, folder: &str) -> Result<bool, DatasetError> {
    let bytes = place.read(&below(folder, SETTINGS_FILE)).await?;
    let settings: serde_json::Value = serde_json::from_slice(&bytes).unwrap_or_default();
    Ok(settings["fnsf"].is_string() && settings["plan"].is_string())
}

/// The drives below a place: folders with two sweeps or more.
pub(super) async fn drives(place: &Place, dataset: Dataset) -> Result<Vec<Drive>, DatasetError> {
    let mut drives = Vec::new();
    let mut waiting = vec![(String::new(), 0)];
    // Links may lead to a folder by many ways.
    let mut seen = HashSet::new();
    while let Some((folder, depth)) = waiting.pop() {
        if let Some(path) = place.without_links(&folder)
            && !seen.insert(path)
        {
            continue;
        }
        let [folders, files] = place.entries(&folder).await?;
        if files.iter().any(|file| file == SETTINGS_FILE) && is_output(place, &folder).await? {
            continue;
        }
        let is_sweep = |name: &String| ENDINGS.iter().any(|end| name.ends_with(end));
        let mut sweeps: Vec<String> = files.into_iter().filter(is_sweep).collect();
        if sweeps.len() > 1 && is_asked_for(&folder, dataset) {
            sweeps.sort_by(|one, other| compare_names(one, other));
            drives.push(drive(place, &folder, &sweeps).await?);
        }
        if depth < MAX_DEPTH {
            // Taken from the end, so the first comes last.
            let folders = folders
                .into_iter()
                .rev()
                .filter(|name| !name.starts_with('_') && name != LOST);
            waiting.extend(folders.map(|name| (below(&folder, &name), depth + 1)));
        }
    }
    Ok(drives)
}

async fn drive(place: &Place, folder: &str, files: &[String]) -> Result<Drive, DatasetError> {
    let mut sweeps: Vec<DriveSweep> = files
        .iter()
        .map(|file| DriveSweep {
            uri: place.uri(&below(folder, file)),
            key: key_of(stem(file)),
            pose: None,
            time_s: None,
        })
        .collect();
    let mut bad_poses = None;
    if let Some(log) = folder.strip_suffix(AV2_SWEEPS) {
        let file = format!("{log}city_SE3_egovehicle.feather");
        match place.read(&file).await {
            Err(PlaceError::Missing(_)) => {}
            Err(error) if error.may_pass() => return Err(error.into()),
            Err(error) => bad_poses = Some(error.to_string()),
            Ok(bytes) => {
                let names: Vec<&str> = files.iter().map(String::as_str).collect();
                match read_poses(&bytes, &names) {
                    Ok(poses) => {
                        for (sweep, pose) in sweeps.iter_mut().zip(poses) {
                            sweep.pose = Some(pose);
                        }
                    }
                    Err(error) => bad_poses = Some(format!("{}: {error}", place.uri(&file))),
                }
            }
        }
    }
    Ok(Drive {
        name: name(folder),
        sweeps,
        bad_poses,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drives_have_the_names_of_their_data_sets() {
        for (folder, expected) in [
            ("7fab/sensors/lidar", "7fab"),
            (
                "2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data",
                "2011_09_26/2011_09_26_drive_0005_sync",
            ),
            ("sequences/04/velodyne", "sequences/04"),
            ("left_velodyne", "left_velodyne"),
            ("my drives/7", "my_drives/7"),
            ("", ""),
        ] {
            assert_eq!(name(folder), expected);
        }
        assert!(is_asked_for("x/sensors/lidar", Dataset::Argoverse2));
        assert!(!is_asked_for("x/sensors/cameras", Dataset::Argoverse2));
        assert!(is_asked_for("training/velodyne/0007", Dataset::Kitti));
    }
}
