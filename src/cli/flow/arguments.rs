//! The options of `fnsf flow`, and what of them is refused before any work.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::{Args, ValueEnum};

use super::follow::FollowArguments;
use crate::cli::estimation::{Estimation, Surroundings};
use crate::cli::failure::Failure;
use crate::cli::files;
use crate::cli::tracks::TrackArguments;
use crate::flow::Ego;
use crate::formats::FlowFormat;
use crate::job::JobOptions;

/// Estimate the displacement of every point between two sweeps, or for each pair of a sequence.
///
/// Reads npz, npy, ply, pcd, las, KITTI bin, nuScenes pcd.bin and Argoverse 2 feather, recognized by
/// content. The flow has one row per source point, in metres: the point's position at the target's
/// time in the target's frame, minus its position in the source's frame. Each flow of a sequence is
/// written as soon as it is estimated. With neural, the fit of a pair starts from the pair before.
/// With label, a pair is estimated from the sweeps around it too.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf flow a.feather b.feather -o flow.npz\n  \
    fnsf flow pair.npz --ground mask --crop-m 51.2 -o flow.ply --picture flow.png\n  \
    fnsf flow a.pcd b.pcd --preset paper --max-points 8192 --json\n  \
    fnsf flow sweeps/*.pcd -o flows/flow.npz        flows/flow_0000.npz, flow_0001.npz, ...\n  \
    fnsf flow sweeps/*.pcd --preset label --tracks tracks.json --tracks-picture tracks.png\n  \
    fnsf flow --follow incoming -o flows/flow.npz --due-ms 100")]
pub(in crate::cli) struct Flow {
    /// The sweeps, two or more, in the order in which they were recorded; or one .npz file with two
    /// sweeps, as arrays pc1 and pc2
    #[arg(required_unless_present = "follow", value_name = "SWEEP")]
    pub(super) sweeps: Vec<PathBuf>,
    /// File for the flow. Its ending gives the format: .npz, .npy, .feather, .ply, .pcd or .json.
    /// Missing folders are created.
    /// With more than two sweeps the files are numbered: flow.npz becomes flow_0000.npz,
    /// flow_0001.npz, ...
    #[arg(short, long, value_name = "OUT")]
    pub(super) output: Option<PathBuf>,
    /// File for a picture of the flow from above, colored by direction of motion; numbered likewise
    #[arg(long, value_name = "OUT.png")]
    pub(super) picture: Option<PathBuf>,
    /// Print the report of each pair as one JSON object on stdout, instead of text
    #[arg(long)]
    pub(super) json: bool,
    /// Transform sweeps whose points have times (a field offset_ns, t, time, timestamp, offset_time or
    /// time_offset of ply, pcd and feather, or the times of LAS) to one time by the ego motion. auto:
    /// where the two sweeps of a pair then fit clearly better, which they do not if they were deskewed
    /// before. on: always. off: the times are not read. A deskewed flow starts from the deskewed points,
    /// and they are in the files that hold points. With times, objects move for the real time between
    /// their points
    #[arg(long, value_enum, default_value_t)]
    pub(super) deskew: DeskewChoice,
    #[command(flatten)]
    pub(super) follow: FollowArguments,
    #[command(flatten)]
    pub(super) tracks: TrackArguments,
    #[command(flatten)]
    pub(super) estimation: Estimation,
}

/// Whether sweeps are deskewed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(super) enum DeskewChoice {
    /// Where the sweeps fit better then.
    #[default]
    Auto,
    /// Always.
    On,
    /// Never: each sweep counts as measured at one instant.
    Off,
}

/// `path` with the pair's number before the ending, where there are several pairs.
pub(super) fn numbered(path: &Path, pair: usize, pairs: usize) -> PathBuf {
    if pairs < 2 {
        return path.to_owned();
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}_{pair:04}.{ending}"))
}

impl Flow {
    /// Whether files are written, and not only lines on stdout.
    pub(super) fn writes(&self) -> bool {
        let mut files = self
            .output
            .iter()
            .chain(&self.picture)
            .chain(self.tracks.outputs());
        files.next().is_some()
    }

    /// Refuses `--deskew on` where no sweep could be deskewed.
    pub(super) fn check_deskew(
        &self,
        surroundings: &Surroundings,
        options: &JobOptions,
    ) -> Result<(), Failure> {
        let refused = if self.deskew != DeskewChoice::On {
            return Ok(());
        } else if self.sweeps.len() < 2 && self.follow.follow.is_none() {
            "the sweeps of an .npz pair have no times, which --deskew on needs"
        } else if surroundings.options(options, 0, [0, 1]).ego == Ego::Off {
            "--deskew on needs the ego motion: give --ego auto, or --poses"
        } else {
            return Ok(());
        };
        Err(Failure::usage(anyhow!(refused)))
    }

    /// Refuses outputs that could not be written. Called before any work.
    pub(super) fn check_outputs(&self) -> Result<(), Failure> {
        let tracks: Vec<PathBuf> = self.tracks.outputs().cloned().collect();
        if self.output.is_none() && self.picture.is_none() && tracks.is_empty() && !self.json {
            return Err(Failure::usage(anyhow!(
                "nothing to do: give -o OUT, --picture OUT.png, --tracks OUT.json or --json"
            )));
        }
        if let Some(output) = &self.output {
            FlowFormat::from_path(output).map_err(Failure::usage)?;
        }
        if let Some(picture) = &self.picture
            && picture.extension().is_none_or(|ending| ending != "png")
        {
            return Err(Failure::usage(anyhow!("a picture's name ends in .png")));
        }
        if let Some(folder) = self.follow.follow.as_deref()
            && !folder.is_dir()
        {
            return Err(Failure::bad_input(anyhow!(
                "{} is no folder",
                folder.display()
            )));
        }
        let named = [&self.output, &self.picture].into_iter().flatten();
        if let Some(folder) = &self.follow.follow
            && let Some(output) = named.clone().find(|path| files::is_in(path, folder))
        {
            return Err(Failure::usage(anyhow!(
                "{} would be written into the folder that is followed: choose another one",
                output.display()
            )));
        }
        let pairs = self.sweeps.len().saturating_sub(1).max(1);
        let named = [&self.output, &self.picture].into_iter().flatten();
        let outputs: Vec<PathBuf> = named
            .flat_map(|path| (0..pairs).map(|pair| numbered(path, pair, pairs)))
            .chain(tracks)
            .collect();
        let known = self.estimation.files();
        files::check_outputs(&outputs, self.sweeps.iter().chain(&known))
    }
}
