//! The arguments of `fnsf unpack`.

use std::path::{Path, PathBuf};

use clap::Args;

/// Write the sweeps of a recording or of a scene as files.
///
/// MCAP: point clouds of ROS 1 and ROS 2 (sensor_msgs/PointCloud2) become files DIR/TOPIC/STAMP.pcd, one for
/// each message. STAMP is the time in the message's header in nanoseconds. Points whose coordinates are not
/// finite are left out and counted.
///
/// OpenSceneFlow's HDF5: the sweeps of a scene become files DIR/SCENE/STAMP.pcd. STAMP is the name of the
/// sweep's group, SCENE that of the file. Where the flow is known, DIR/SCENE/STAMP.npz is the pair with its
/// truth and its ground masks, for fnsf flow, eval and tables.
///
/// The times of the points are kept, for --deskew.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf unpack drive.mcap --list                         # topics with clouds\n  \
    fnsf unpack drive.mcap -o sweeps --topic /lidar/top   # one of them\n  \
    fnsf flow sweeps/lidar_top/*.pcd -o flow.npz          # then, as any sweeps\n  \
    fnsf unpack scene.h5 -o drives                        # a scene of OpenSceneFlow\n  \
    fnsf label drives -o labels                           # the flow of all its pairs")]
pub(in crate::cli) struct Unpack {
    /// Recording or scene: MCAP, chunks not compressed or by lz4 or zstd; or HDF5
    #[arg(value_name = "FILE")]
    pub(super) file: PathBuf,
    /// Folder for the sweeps, with a folder for each topic or scene; created if missing
    #[arg(short, long, value_name = "DIR", required_unless_present = "list")]
    pub(super) output: Option<PathBuf>,
    /// Take this topic of a recording only, as the recording names it
    #[arg(long, value_name = "TOPIC")]
    pub(super) topic: Option<String>,
    /// Leave out so many sweeps of each topic, or of the scene, at the beginning
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(super) skip: usize,
    /// Write at most so many sweeps of each topic, or of the scene
    #[arg(long, value_name = "N")]
    pub(super) limit: Option<usize>,
    /// Print the topics with clouds and the number of their messages, or of sweeps; write nothing
    #[arg(long, conflicts_with = "output")]
    pub(super) list: bool,
}

impl Unpack {
    /// The folder for the sweeps.
    pub(super) fn output(&self) -> &Path {
        self.output.as_deref().unwrap_or(Path::new("."))
    }
}
