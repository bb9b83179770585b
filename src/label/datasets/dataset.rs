//! The data sets whose layouts are known.

use std::fmt;
use std::str::FromStr;

use crate::label::places::PlaceError;

/// A data set, by its layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dataset {
    /// Any folder that holds two sweeps or more, Argoverse 2 and KITTI among them.
    Folders,
    /// Argoverse 2: `LOG/sensors/lidar/TIMESTAMP.feather`.
    Argoverse2,
    /// KITTI: `velodyne_points/data/N.bin`, or `SEQUENCE/velodyne/N.bin`.
    Kitti,
    /// nuScenes: the JSON tables of `v1.0-*`.
    Nuscenes,
}

/// Why the drives of a data set cannot be found.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// Its files cannot be read.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// No drive was found.
    #[error("{place} has no drive of {dataset}: {looked_for} was looked for")]
    None {
        /// The place.
        place: String,
        /// The data set.
        dataset: Dataset,
        /// What was looked for.
        looked_for: &'static str,
    },
    /// A table of the data set cannot be used.
    #[error("{file}: {what}")]
    Table {
        /// The file.
        file: String,
        /// What is wrong.
        what: String,
    },
}

impl fmt::Display for Dataset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Folders => "sweeps",
            Self::Argoverse2 => "av2",
            Self::Kitti => "kitti",
            Self::Nuscenes => "nuscenes",
        })
    }
}

impl FromStr for Dataset {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        Ok(match text {
            "av2" => Self::Argoverse2,
            "kitti" => Self::Kitti,
            "nuscenes" => Self::Nuscenes,
            _ => return Err(()),
        })
    }
}

impl Dataset {
    /// A place with the name of its data set before it, as in `av2:/data/av2/val`.
    pub fn of_place(text: &str) -> (Option<Self>, &str) {
        match text.split_once(':') {
            Some((name, place)) if !place.starts_with("//") => match name.parse() {
                Ok(dataset) => (Some(dataset), place),
                Err(()) => (None, text),
            },
            _ => (None, text),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_before_a_place_is_a_data_set() {
        let taken = |text| Dataset::of_place(text);
        assert_eq!(taken("av2:/d/val"), (Some(Dataset::Argoverse2), "/d/val"));
        assert_eq!(taken("kitti:s3://b/k"), (Some(Dataset::Kitti), "s3://b/k"));
        for plain in ["s3://b/k", "/d:x", "file:///d", "drives"] {
            assert_eq!(taken(plain), (None, plain));
        }
    }
}
