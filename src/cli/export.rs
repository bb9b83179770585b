//! `fnsf export`: the boxes of tracks, and their sweeps, as labelling tools and viewers take them.

use std::ffi::OsStr;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::{Args, ValueEnum};
use indicatif::ProgressBar;

use super::failure::Failure;
use super::files;
use super::output::say;
use super::terminal::bar;
use crate::flow::RigidTransform;
use crate::formats::{
    BoxLayout, BoxSequence, CloudFormat, FormatError, NuscenesScene, SceneRecording, read_cloud,
    write_cloud,
};
use crate::text::grouped;

/// Write the boxes of tracks as labelling tools and viewers take them.
///
/// TRACKS.json comes from `fnsf flow --tracks` or `fnsf label --tracks`. A track is one object with one
/// identity, and has a box of one size in each of its sweeps. Where it is hidden, its box is predicted.
/// The sweeps are written beside, as pcd. The folder, or a zip of it, is what the tool imports. With
/// `--layout mcap` all is one recording, DIR/scene.mcap.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf flow sweeps/*.pcd -o flow.npz --tracks tracks.json\n  \
    fnsf export tracks.json sweeps/*.pcd --layout supervisely -o project\n  \
    fnsf export tracks.json sweeps/*.pcd --layout cvat -o project && (cd project && zip -r ../project.zip .)\n  \
    fnsf export tracks.json sweeps/*.pcd --layout kitti-tracking --camera calib.txt --class Car -o kitti\n  \
    fnsf export tracks.json sweeps/*.pcd.bin --layout nuscenes-tracking --tables v1.0-mini --class car -o results\n  \
    fnsf export tracks.json sweeps/*.pcd --layout mcap --poses poses.txt -o scene")]
pub(super) struct Export {
    /// Tracks of a sequence
    #[arg(value_name = "TRACKS.json")]
    tracks: PathBuf,
    /// All sweeps of the sequence, in its order
    #[arg(value_name = "SWEEP", required = true)]
    sweeps: Vec<PathBuf>,
    /// What to write
    #[arg(long, value_enum)]
    layout: Layout,
    /// Folder for the files; created if missing. Files of the same names are replaced
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Class of all boxes, one that the tool's project has. Argoverse 2 has REGULAR_VEHICLE, for one
    #[arg(long, value_name = "NAME", default_value = "mover")]
    class: String,
    /// Poses of all sweeps, for the motion of the sensor in --layout mcap: the formats of fnsf flow --poses
    #[arg(long, value_name = "FILE")]
    poses: Option<PathBuf>,
    /// Calibration of KITTI, for --layout kitti-tracking: calib_cam_to_cam.txt with calib_velo_to_cam.txt in
    /// the same folder, or the calibration of the tracking or object benchmark
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// Tables of nuScenes, for --layout nuscenes-tracking: a folder such as v1.0-mini. Sweeps are found in them by
    /// their file names
    #[arg(long, value_name = "DIR")]
    tables: Option<PathBuf>,
}

/// The recording of [`Layout::Mcap`].
const RECORDING: &str = "scene.mcap";

/// A [`BoxLayout`] by its name, or a recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Layout {
    /// Supervisely, point cloud episodes
    Supervisely,
    /// CVAT, "Sly Point Cloud Format 1.0"
    Cvat,
    /// SUSTechPOINTS
    Sustechpoints,
    /// Argoverse 2: annotations.feather, of sweeps that are named by their nanoseconds
    Av2,
    /// KITTI's tracking benchmark: label_02/0000.txt with the boxes that the camera sees
    KittiTracking,
    /// KITTI's raw data: tracklet_labels.xml
    KittiTracklets,
    /// nuScenes' tracking task: tracking.json with the boxes of key frames
    NuscenesTracking,
    /// MCAP with the messages of Foxglove: clouds, boxes, velocities, and with --poses the motion of the sensor
    Mcap,
}

impl Layout {
    fn name(self) -> String {
        let value = self.to_possible_value().expect("no layout is hidden");
        value.get_name().to_owned()
    }
}

/// The name of a sweep: its file name without ending.
fn name_of(sweep: &Path) -> Result<String, Failure> {
    let name = sweep.file_stem().and_then(OsStr::to_str);
    name.map(str::to_owned).ok_or_else(|| {
        let message = format!("{} is no file name of a sweep", sweep.display());
        Failure::bad_input(anyhow!(message))
    })
}

impl Export {
    pub(super) fn run(&self) -> Result<(), Failure> {
        self.check_options()?;
        let scenes = match self.layout {
            Layout::NuscenesTracking => {
                files::read_nuscenes(self.needed(self.tables.as_ref(), "--tables")?)?
            }
            _ => Vec::new(),
        };
        let boxes_only = self.boxes_only(&scenes)?;
        let tracks = files::read_tracks(&self.tracks)?;
        let names: Result<Vec<String>, Failure> =
            self.sweeps.iter().map(|sweep| name_of(sweep)).collect();
        let names = names?;
        let unusable = || self.tracks.display().to_string();
        let sequence = BoxSequence::new(&tracks, &names, &self.class);
        let sequence = sequence
            .with_context(unusable)
            .map_err(Failure::bad_input)?;
        let mut in_image = String::new();
        let clouds = match boxes_only {
            None => self.recording(&sequence)?,
            Some(layout) => {
                let written = layout.files(&sequence).with_context(unusable);
                for file in &written.map_err(Failure::bad_input)? {
                    self.write(&file.path, |out| out.write_all(&file.bytes))?;
                    if let BoxLayout::KittiTracking(_) = layout {
                        let lines = file.bytes.iter().filter(|&&byte| byte == b'\n').count();
                        in_image = format!(", {} of them in the image", grouped(lines));
                    }
                }
                self.clouds(layout, &names)?
            }
        };
        if clouds > 0 {
            self.warn_of_times()?;
        }
        let boxes: usize = tracks.iter().map(|track| track.states.len()).sum();
        let clouds = match clouds {
            0 => String::new(),
            clouds => format!(", {} clouds", grouped(clouds)),
        };
        say(format_args!(
            "{} tracks, {} boxes in {} sweeps{in_image}{clouds}, in {}",
            grouped(tracks.len()),
            grouped(boxes),
            grouped(names.len()),
            self.output.display()
        ))
    }

    /// Warns where the boxes may be those of deskewed sweeps: the points of the files lie elsewhere.
    fn warn_of_times(&self) -> Result<(), Failure> {
        let [first, ..] = self.sweeps.as_slice() else {
            return Ok(());
        };
        if files::read_timed_cloud(first)?.times.is_some() {
            files::warn_of_times("tracks");
        }
        Ok(())
    }

    /// Refuses options of other layouts.
    fn check_options(&self) -> Result<(), Failure> {
        for (option, is_given, layout) in [
            ("--poses", self.poses.is_some(), Layout::Mcap),
            ("--camera", self.camera.is_some(), Layout::KittiTracking),
            ("--tables", self.tables.is_some(), Layout::NuscenesTracking),
        ] {
            if is_given && self.layout != layout {
                let layout = layout.name();
                return Err(Failure::usage(anyhow!("{option} is for --layout {layout}")));
            }
        }
        Ok(())
    }

    /// The file of an option that the layout cannot do without.
    fn needed<'a>(&self, file: Option<&'a PathBuf>, option: &str) -> Result<&'a PathBuf, Failure> {
        let layout = self.layout.name();
        file.ok_or_else(|| Failure::usage(anyhow!("--layout {layout} needs {option}")))
    }

    /// The layout of boxes. None for a recording.
    fn boxes_only<'a>(
        &self,
        scenes: &'a [NuscenesScene],
    ) -> Result<Option<BoxLayout<'a>>, Failure> {
        Ok(Some(match self.layout {
            Layout::Supervisely => BoxLayout::Supervisely,
            Layout::Cvat => BoxLayout::Cvat,
            Layout::Sustechpoints => BoxLayout::Sustechpoints,
            Layout::Av2 => BoxLayout::Av2,
            Layout::KittiTracking => {
                let camera = self.needed(self.camera.as_ref(), "--camera")?;
                BoxLayout::KittiTracking(files::read_kitti_camera(camera)?)
            }
            Layout::KittiTracklets => BoxLayout::KittiTracklets,
            Layout::NuscenesTracking => BoxLayout::NuscenesTracking(scenes),
            Layout::Mcap => return Ok(None),
        }))
    }

    /// Writes the clouds of the sweeps, where the layout has them. Returns their number.
    fn clouds(&self, layout: BoxLayout<'_>, names: &[String]) -> Result<usize, Failure> {
        let bar = self.bar();
        let mut clouds = 0;
        for (sweep, name) in self.sweeps.iter().zip(names) {
            bar.inc(1);
            let Some(path) = layout.cloud_path(name) else {
                continue;
            };
            clouds += 1;
            if files::identity(sweep).is_some_and(|own| Some(own) == self.identity(&path)) {
                // It is in its place.
                continue;
            }
            if sweep.extension().is_some_and(|ending| ending == "pcd") {
                // It keeps its other columns.
                let bytes = files::read_bytes(sweep)?;
                read_cloud(&bytes, sweep.to_str())
                    .with_context(|| sweep.display().to_string())
                    .map_err(Failure::bad_input)?;
                self.write(&path, |out| out.write_all(&bytes))?;
            } else {
                let points = files::read_cloud(sweep)?;
                self.write::<FormatError>(&path, |out| {
                    write_cloud(CloudFormat::Pcd, &points, out)
                })?;
            }
        }
        bar.finish_and_clear();
        Ok(clouds)
    }

    /// Writes the recording. Returns the number of its clouds.
    fn recording(&self, sequence: &BoxSequence<'_>) -> Result<usize, Failure> {
        let poses = self.poses.as_ref();
        let poses = poses.map(|file| files::read_poses(file, &self.sweeps));
        let poses: Option<Vec<RigidTransform>> = poses.transpose()?;
        let bar = self.bar();
        let mut unreadable = None;
        let written = self.write(RECORDING, |out| {
            let mut scene = SceneRecording::start(sequence, poses.as_deref(), out)?;
            for sweep in &self.sweeps {
                bar.inc(1);
                match files::read_cloud(sweep) {
                    Ok(points) => scene.sweep(&points)?,
                    Err(failure) => {
                        unreadable = Some(failure);
                        return Err(io::Error::other("a sweep cannot be read"));
                    }
                }
            }
            scene.finish()
        });
        bar.finish_and_clear();
        match unreadable {
            Some(failure) => Err(failure),
            None => written.map(|()| self.sweeps.len()),
        }
    }

    fn bar(&self) -> ProgressBar {
        bar(
            self.sweeps.len() as u64,
            "{wide_bar:.cyan/blue} {pos} of {len} sweeps",
        )
    }

    /// What the file of the layout at `path` is, if it is there.
    fn identity(&self, path: &str) -> Option<(u64, u64)> {
        files::identity(&self.output.join(path))
    }

    /// Writes a file of the layout. Refuses to write over an input.
    fn write<E: std::error::Error + Send + Sync + 'static>(
        &self,
        path: &str,
        writer: impl FnOnce(&mut io::BufWriter<fs::File>) -> Result<(), E>,
    ) -> Result<(), Failure> {
        let place = self.identity(path);
        let mut inputs = self.sweeps.iter().chain([&self.tracks]);
        if place.is_some() && inputs.any(|input| files::identity(input) == place) {
            let place = self.output.join(path);
            return Err(Failure::usage(anyhow!(
                "{} would be written over: give another folder",
                place.display()
            )));
        }
        files::write_below(&self.output, Path::new(path), writer)
    }
}
