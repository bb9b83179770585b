//! `fnsf export`: the boxes of tracks, and their sweeps, as labelling tools take them.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::{Args, ValueEnum};

use super::failure::Failure;
use super::files;
use super::output::say;
use super::terminal::bar;
use crate::formats::{BoxLayout, BoxSequence, CloudFormat, FormatError, read_cloud, write_cloud};
use crate::text::grouped;

/// Write the boxes of tracks as labelling tools take them.
///
/// TRACKS.json comes from `fnsf flow --tracks` or `fnsf label --tracks`. A track is one object with one
/// identity, and has a box of one size in each of its sweeps. Where it is hidden, its box is predicted.
/// The sweeps are written beside, as pcd. The folder, or a zip of it, is what the tool imports.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf flow sweeps/*.pcd -o flow.npz --tracks tracks.json\n  \
    fnsf export tracks.json sweeps/*.pcd --layout supervisely -o project\n  \
    fnsf export tracks.json sweeps/*.pcd --layout cvat -o project && (cd project && zip -r ../project.zip .)")]
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
}

/// A [`BoxLayout`] by its name.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Layout {
    /// Supervisely, point cloud episodes
    Supervisely,
    /// CVAT, "Sly Point Cloud Format 1.0"
    Cvat,
    /// SUSTechPOINTS
    Sustechpoints,
    /// Argoverse 2: annotations.feather, of sweeps that are named by their nanoseconds
    Av2,
}

impl From<Layout> for BoxLayout {
    fn from(layout: Layout) -> Self {
        match layout {
            Layout::Supervisely => Self::Supervisely,
            Layout::Cvat => Self::Cvat,
            Layout::Sustechpoints => Self::Sustechpoints,
            Layout::Av2 => Self::Av2,
        }
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
        let tracks = files::read_tracks(&self.tracks)?;
        let names: Result<Vec<String>, Failure> =
            self.sweeps.iter().map(|sweep| name_of(sweep)).collect();
        let names = names?;
        let unusable = || self.tracks.display().to_string();
        let sequence = BoxSequence::new(&tracks, &names, &self.class);
        let written = sequence.and_then(|sequence| BoxLayout::from(self.layout).files(&sequence));
        let written = written.with_context(unusable).map_err(Failure::bad_input)?;
        for file in &written {
            self.write(&file.path, |out| {
                std::io::Write::write_all(out, &file.bytes)
            })?;
        }
        let clouds = self.clouds(&names)?;
        let boxes: usize = tracks.iter().map(|track| track.states.len()).sum();
        let clouds = match clouds {
            0 => String::new(),
            clouds => format!(", {} clouds", grouped(clouds)),
        };
        say(format_args!(
            "{} tracks, {} boxes in {} sweeps{clouds}, in {}",
            grouped(tracks.len()),
            grouped(boxes),
            grouped(names.len()),
            self.output.display()
        ))
    }

    /// Writes the clouds of the sweeps, where the layout has them. Returns their number.
    fn clouds(&self, names: &[String]) -> Result<usize, Failure> {
        let bar = bar(
            names.len() as u64,
            "{wide_bar:.cyan/blue} {pos} of {len} sweeps",
        );
        let mut clouds = 0;
        for (sweep, name) in self.sweeps.iter().zip(names) {
            bar.inc(1);
            let Some(path) = BoxLayout::from(self.layout).cloud_path(name) else {
                continue;
            };
            clouds += 1;
            if sweep.extension().is_some_and(|ending| ending == "pcd") {
                // It keeps its other columns.
                let bytes = files::read_bytes(sweep)?;
                read_cloud(&bytes, sweep.to_str())
                    .with_context(|| sweep.display().to_string())
                    .map_err(Failure::bad_input)?;
                self.write(&path, |out| std::io::Write::write_all(out, &bytes))?;
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

    /// Writes a file of the layout.
    fn write<E: std::error::Error + Send + Sync + 'static>(
        &self,
        path: &str,
        writer: impl FnOnce(&mut std::io::BufWriter<fs::File>) -> Result<(), E>,
    ) -> Result<(), Failure> {
        let path = self.output.join(path);
        let folder = path.parent().unwrap_or(&self.output);
        fs::create_dir_all(folder)
            .with_context(|| format!("cannot make {}", folder.display()))
            .map_err(Failure::internal)?;
        files::write(&path, writer)
    }
}
