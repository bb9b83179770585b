//! Files: clouds, pairs, flow, tracks, cameras, poses and depth images, in the common formats.
//!
//! Formats are recognized by content, and sizes are checked before memory is allocated. Independent
//! of the file system, jobs, solvers and the command line.

mod error;
mod limits;
mod lines;
mod sniff;
mod sweep_order;
mod timestamps;

mod av2_challenge;
mod boxes;
mod camera;
mod cloud;
mod dense_file;
mod depth_png;
mod flow_file;
mod ground_raster;
mod intensity;
mod motion;
mod nuscenes;
mod pair;
mod point_times;
mod poses;
mod scene;
mod semantic_kitti;
mod tracks;

mod bin;
mod feather;
mod las_read;
mod las_write;
mod lzf;
mod mcap;
mod npy;
mod npz;
mod pcd;
mod ply;
mod scalar;

pub use crate::formats::av2_challenge::{Av2Challenge, read_av2_mask, write_av2_challenge};
pub use crate::formats::boxes::{BoxLayout, BoxSequence, KittiCamera, LayoutFile, SceneRecording};
pub use crate::formats::camera::{KITTI_SIZE_PX, read_camera, read_camera0_from_lidar};
pub use crate::formats::cloud::{
    Cloud, CloudFormat, TimedCloud, declared_rows, read_cloud, read_cloud_within, read_timed_cloud,
    working_bytes, write_cloud, write_timed_pcd,
};
pub use crate::formats::dense_file::{DENSE_FORMATS, DenseFormat, is_dense, write_dense};
pub use crate::formats::depth_png::{read_depth_png, write_depth_png};
pub use crate::formats::error::{FileKind, FormatError};
pub use crate::formats::flow_file::{FlowFile, FlowFormat, FlowTable, read_flow, write_flow};
pub use crate::formats::ground_raster::GroundRaster;
pub use crate::formats::intensity::read_intensity;
pub use crate::formats::limits::{MAX_COORDINATE_M, MAX_POINTS};
pub use crate::formats::mcap::{CloudMessage, RecordedSweep, read_recording};
pub use crate::formats::motion::{ego_motion, matrix_rows, read_motion, rigid_motion};
pub use crate::formats::nuscenes::{NUSCENES_TABLES, NuscenesScene, NuscenesSweep, read_nuscenes};
pub use crate::formats::pair::{
    Av2Labels, Ground, Pair, PairTruth, is_pair, read_av2_labels, read_pair, read_pair_within,
    write_pair_npz,
};
pub use crate::formats::point_times::PointTimes;
pub use crate::formats::poses::{PoseFile, read_poses};
pub use crate::formats::scene::{Scene, SceneSweep};
pub use crate::formats::semantic_kitti::moving_labels;
pub use crate::formats::sniff::recognize;
pub use sweep_order::{SweepOrder, compare_names, turning_sweep};
pub use timestamps::{
    INTERVAL_S, SweepClock, SweepTime, TimeUnit, is_interval, pair_interval_s, sweep_time_s,
};
pub use tracks::{is_tracks, read_tracks, write_tracks};
