//! Files in and out: clouds, pairs and flow in the formats that people have.
//!
//! Recognized by content, checked before anything is allocated, refused by name. It knows bytes
//! and the vocabulary of `flow`; it must not know files, jobs, solvers or the command line.

mod error;
mod limits;
mod lines;
mod sniff;

mod camera;
mod cloud;
mod dense_file;
mod depth_png;
mod flow_file;
mod ground_raster;
mod motion;
mod pair;
mod poses;

mod bin;
mod feather;
mod las;
mod lzf;
mod npy;
mod npz;
mod pcd;
mod ply;
mod scalar;

pub use camera::{KITTI_SIZE_PX, read_camera, read_camera0_from_lidar};
pub use cloud::{Cloud, CloudFormat, declared_rows, read_cloud, read_cloud_within, write_cloud};
pub use dense_file::{DENSE_FORMATS, DenseFormat, write_dense};
pub use depth_png::{read_depth_png, write_depth_png};
pub use error::{FileKind, FormatError};
pub use flow_file::{FlowFile, FlowFormat, FlowTable, read_flow, write_flow};
pub use ground_raster::GroundRaster;
pub use limits::{MAX_COORDINATE_M, MAX_POINTS};
pub use motion::{ego_motion, matrix_rows, read_motion, rigid_motion};
pub use pair::{
    Av2Labels, Ground, Pair, PairTruth, is_pair, read_av2_labels, read_pair, read_pair_within,
    write_pair_npz,
};
pub use poses::read_poses;
pub use sniff::recognize;
