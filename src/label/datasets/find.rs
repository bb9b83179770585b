//! The choice of the data set.

use super::dataset::{Dataset, DatasetError};
use super::{folders, nuscenes};
use crate::label::places::Place;
use crate::label::plan::Drive;

/// Finds the drives below a place, in order of their names.
///
/// # Errors
/// [`DatasetError`].
pub(in crate::label) async fn drives_of(
    asked: Option<Dataset>,
    place: &Place,
) -> Result<Vec<Drive>, DatasetError> {
    let is_nuscenes = match asked {
        None => nuscenes::tables(place).await?.is_some(),
        Some(dataset) => dataset == Dataset::Nuscenes,
    };
    if is_nuscenes {
        return nuscenes::drives(place).await;
    }
    let asked = asked.unwrap_or(Dataset::Folders);
    let drives = folders::drives(place, asked).await?;
    match drives.is_empty() {
        false => Ok(drives),
        true => Err(DatasetError::None {
            place: place.uri(""),
            dataset: asked,
            looked_for: match asked {
                Dataset::Argoverse2 => "LOG/sensors/lidar/*.feather",
                Dataset::Kitti => "velodyne_points/data/*.bin or velodyne/*.bin",
                Dataset::Folders | Dataset::Nuscenes => {
                    "a folder with two files .pcd, .ply, .bin, .npy, .feather or .las"
                }
            },
        }),
    }
}
