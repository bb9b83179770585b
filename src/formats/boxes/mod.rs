//! Boxes of tracks in the layouts of labelling tools and data sets, and as recordings for viewers.

mod av2_annotations;
mod kitti_tracking;
mod kitti_tracklets;
mod layout;
mod layout_file;
mod nuscenes_tracking;
#[cfg(test)]
mod samples;
mod scene;
mod sequence;
mod supervisely;
mod sustechpoints;

pub use crate::formats::boxes::kitti_tracking::KittiCamera;
pub use crate::formats::boxes::layout::BoxLayout;
pub use crate::formats::boxes::layout_file::LayoutFile;
pub use crate::formats::boxes::scene::SceneRecording;
pub use crate::formats::boxes::sequence::BoxSequence;
