//! The layouts, and the files of each.

use super::av2_annotations;
use super::kitti_tracking::{self, KittiCamera};
use super::kitti_tracklets;
use super::layout_file::LayoutFile;
use super::nuscenes_tracking;
use super::sequence::BoxSequence;
use super::supervisely::{self, Project};
use super::sustechpoints;
use crate::formats::error::FormatError;
use crate::formats::nuscenes::NuscenesScene;

/// A layout of labelling tools or of a data set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BoxLayout<'a> {
    /// Supervisely, point cloud episodes: objects with figures in the frames of one sequence.
    Supervisely,
    /// CVAT, "Sly Point Cloud Format 1.0": a file of figures for each sweep.
    Cvat,
    /// SUSTechPOINTS: label/SWEEP.json beside lidar/SWEEP.pcd.
    Sustechpoints,
    /// Argoverse 2: annotations.feather. The names of the sweeps are their times in nanoseconds.
    Av2,
    /// KITTI's tracking benchmark: label_02/0000.txt, of the boxes that a camera sees.
    KittiTracking(KittiCamera),
    /// KITTI's raw data: tracklet_labels.xml.
    KittiTracklets,
    /// nuScenes' tracking task: tracking.json, the boxes of key frames in the frame of the map. The scenes
    /// have the sweeps, by the names of their files.
    NuscenesTracking(&'a [NuscenesScene]),
}

impl BoxLayout<'_> {
    /// Where the cloud of a sweep lies, as pcd, in the folder of the layout. None where the layout has
    /// no clouds.
    pub fn cloud_path(self, sweep: &str) -> Option<String> {
        match self {
            Self::Supervisely | Self::Cvat => Some(supervisely::cloud_path(sweep)),
            Self::Sustechpoints => Some(format!("lidar/{sweep}.pcd")),
            Self::Av2
            | Self::KittiTracking(_)
            | Self::KittiTracklets
            | Self::NuscenesTracking(_) => None,
        }
    }

    /// The files of the boxes. The same sequence gives the same bytes.
    ///
    /// # Errors
    /// `Unsupported` for [`BoxLayout::Av2`] and a sweep without a time in its name, for
    /// [`BoxLayout::KittiTracking`] and a class that is not one word, for [`BoxLayout::KittiTracklets`] and a
    /// track with a gap, and for
    /// [`BoxLayout::NuscenesTracking`] and a class or a sweep that the data set does not have.
    /// [`FormatError::Write`] if arrow fails.
    pub fn files(self, sequence: &BoxSequence<'_>) -> Result<Vec<LayoutFile>, FormatError> {
        Ok(match self {
            Self::Supervisely => supervisely::files(sequence, Project::Episode),
            Self::Cvat => supervisely::files(sequence, Project::Clouds),
            Self::Sustechpoints => sustechpoints::files(sequence),
            Self::Av2 => vec![av2_annotations::file(sequence)?],
            Self::KittiTracking(camera) => vec![kitti_tracking::file(sequence, &camera)?],
            Self::KittiTracklets => vec![kitti_tracklets::file(sequence)?],
            Self::NuscenesTracking(scenes) => vec![nuscenes_tracking::file(sequence, scenes)?],
        })
    }
}
