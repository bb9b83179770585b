//! `fnsf flow`: pairs of sweeps, here and now.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;

use super::estimation::{Estimation, check_sequence};
use super::failure::Failure;
use super::files;
use super::machine::peak_resident_bytes;
use super::output::say;
use super::terminal::Terminal;
use crate::flow::{Control, Estimate, Point, Sequence, Sweep};
use crate::formats::{FlowFormat, FlowTable, write_flow};
use crate::job::Report;
use crate::picture::{self, TopDown, TopDownOptions};
use crate::text::grouped;

/// Estimate the motion of every point between two sweeps, or of a sequence's pairs.
///
/// Reads npz, npy, ply, pcd, KITTI bin, nuScenes pcd.bin and Argoverse 2 feather, recognized by
/// content. The flow has one row per source point: where the point is in the target's frame, less
/// where it was in the source's, in metres. Of a sequence every flow is written as soon as it
/// is there; with neural each pair starts from the one before, with label each sees the sweeps around it.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf flow a.feather b.feather -o flow.npz\n  \
    fnsf flow pair.npz --ground mask --range-m 51.2 -o flow.ply --picture flow.png\n  \
    fnsf flow a.pcd b.pcd --preset paper --max-points 8192 --json\n  \
    fnsf flow sweeps/*.pcd -o flows/flow.npz        flows/flow_0000.npz, flow_0001.npz, ...")]
pub(super) struct Flow {
    /// Two sweeps or more, in order; or one .npz with two, as arrays pc1 and pc2
    #[arg(required = true, value_name = "SWEEP")]
    sweeps: Vec<PathBuf>,
    /// Where the flow goes: .npz, .npy, .feather, .ply, .pcd or .json. The flows of more than two
    /// sweeps are numbered: flow.npz becomes flow_0000.npz, flow_0001.npz, ...
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Draw the flow from above, colored by direction; numbered likewise
    #[arg(long, value_name = "OUT.png")]
    picture: Option<PathBuf>,
    /// Print one JSON object for each pair on stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    estimation: Estimation,
}

/// A pair whose flow is still to come.
struct Waiting {
    pair: usize,
    source: Vec<Point>,
    /// Seconds that its target took to read.
    load: f64,
}

/// Writes the flow in the format that the name asks for.
fn write(estimate: &Estimate, source: &[Point], path: &Path) -> Result<(), Failure> {
    let format = FlowFormat::from_path(path).map_err(Failure::usage)?;
    let table = FlowTable {
        source,
        flow: &estimate.flow,
        valid: &estimate.valid,
        dynamic: estimate.dynamic.as_deref(),
        objects: estimate.objects.as_ref(),
        ego: estimate.ego.as_ref(),
    };
    files::write(path, |file| write_flow(format, &table, file))
}

/// Draws the flow from above.
fn draw(estimate: &Estimate, source: &[Point], path: &Path) -> Result<(), Failure> {
    let image = picture::top_down(
        &TopDown {
            source,
            flow: &estimate.flow,
            valid: &estimate.valid,
            ego: estimate.ego.as_ref(),
            clusters: estimate
                .objects
                .as_ref()
                .map_or(&[], |objects| objects.clusters.as_slice()),
        },
        &TopDownOptions::default(),
    );
    files::write(path, |file| picture::write_png(&image, file))
}

/// What a person reads of a report.
pub(super) fn print_report(report: &Report) -> Result<(), Failure> {
    let seconds = &report.seconds;
    say(format_args!(
        "flow of {} points in {:.2} s on {}",
        grouped(report.points),
        seconds.total,
        report.device
    ))?;
    let load = seconds.load.map(|load| format!("load {load:.2} s, "));
    let (load, precompute) = (load.unwrap_or_default(), seconds.precompute);
    let loss = report.best_loss.map(|loss| format!(", loss {loss:.4} m"));
    let (preset, reason, loss) = (
        &report.preset,
        &report.stop_reason,
        loss.unwrap_or_default(),
    );
    if let Some(moving) = report.moving {
        let (movers, clusters) = (seconds.network, report.iterations);
        say(format_args!(
            "  {load}precompute {precompute:.2} s, movers {movers:.2} s"
        ))?;
        say(format_args!(
            "  preset {preset}: {clusters} clusters, {moving} move ({reason}){loss}"
        ))?;
    } else {
        let (query, network) = (seconds.query, seconds.network);
        let (seed, iterations) = (report.seed, report.iterations);
        say(format_args!(
            "  {load}precompute {precompute:.2} s, query {query:.2} s, network {network:.2} s"
        ))?;
        say(format_args!(
            "  preset {preset}, seed {seed}: {iterations} iterations ({reason}){loss}"
        ))?;
    }
    if let Some(motion) = report.ego_motion {
        let [x, y, z] = [motion[0][3], motion[1][3], motion[2][3]];
        say(format_args!(
            "  ego motion {x:.3}, {y:.3}, {z:.3} m (target from source)"
        ))?;
    }
    Ok(())
}

/// `path` with the pair's number before its ending, where there are several.
fn numbered(path: &Path, pair: usize, pairs: usize) -> PathBuf {
    if pairs < 2 {
        return path.to_owned();
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}_{pair:04}.{ending}"))
}

/// Sweeps to be read one after the other, or those of one file.
enum Sweeps<'a> {
    Files(&'a [PathBuf]),
    Pair(Box<[Sweep; 2]>),
}

impl Sweeps<'_> {
    fn count(&self) -> usize {
        match self {
            Self::Files(files) => files.len(),
            Self::Pair(pair) => pair.len(),
        }
    }
}

impl Flow {
    pub(super) fn run(&self) -> Result<(), Failure> {
        self.check_outputs()?;
        let terminal = Terminal::new();
        let options = self.estimation.options()?;
        let sweeps = match self.sweeps.as_slice() {
            [pair] => {
                let pair = files::read_pair(pair)?;
                let (source, target) = match pair.ground {
                    Some(ground) => (Some(ground.source), Some(ground.target)),
                    None => (None, None),
                };
                let sweep = |points, ground| Sweep { points, ground };
                Sweeps::Pair(Box::new([
                    sweep(pair.source, source),
                    sweep(pair.target, target),
                ]))
            }
            files => {
                check_sequence(&options, files.len())?;
                Sweeps::Files(files)
            }
        };
        let surroundings = self.estimation.surroundings(&self.sweeps)?;
        let mut device = self.estimation.open()?;
        let mut sequence = Sequence::default();
        // What is known of the pairs that wait for sweeps to come, and of the last sweep.
        let mut waiting: VecDeque<Waiting> = VecDeque::new();
        let mut last = None::<Vec<Point>>;
        let count = sweeps.count();
        for place in 0..count {
            let began = terminal.seconds();
            let sweep = match &sweeps {
                Sweeps::Pair(pair) => pair[place].clone(),
                Sweeps::Files(files) => surroundings.sweep(place, &files[place])?,
            };
            let load = terminal.seconds() - began;
            let points = sweep.points.clone();
            let larger = points.len().max(last.as_ref().map_or(0, Vec::len));
            let pair = [place.saturating_sub(1), place];
            let solver_options = surroundings.options(&options, larger, pair);
            if let Some(source) = last.replace(points) {
                waiting.push_back(Waiting {
                    pair: pair[0],
                    source,
                    load,
                });
            }
            let mut found = device.push(&mut sequence, &sweep, &solver_options, &terminal)?;
            // What is there is written before the next pair, which may fail, is tried.
            loop {
                terminal.finish();
                for (estimate, pair) in found.iter().zip(waiting.drain(..found.len())) {
                    let mut report = Report::new(estimate, &options);
                    report.seconds.load = Some(pair.load);
                    report.seconds.total += pair.load;
                    report.peak_rss_bytes = peak_resident_bytes();
                    self.put(estimate, &report, &pair.source, [pair.pair, count - 1])?;
                }
                if place + 1 < count {
                    break;
                }
                found = device.finish(&mut sequence, &terminal)?;
                if found.is_empty() {
                    break;
                }
            }
        }
        Ok(())
    }

    /// Refuses, before any work, what could not be written at its end.
    fn check_outputs(&self) -> Result<(), Failure> {
        if self.output.is_none() && self.picture.is_none() && !self.json {
            return Err(Failure::usage(anyhow!(
                "nothing to do: give -o OUT, --picture OUT.png or --json"
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
        let pairs = self.sweeps.len().saturating_sub(1).max(1);
        let named = [&self.output, &self.picture].into_iter().flatten();
        let outputs: Vec<PathBuf> = named
            .flat_map(|path| (0..pairs).map(|pair| numbered(path, pair, pairs)))
            .collect();
        let known = self.estimation.files();
        files::check_outputs(&outputs, self.sweeps.iter().chain(&known))
    }

    /// Writes, draws and prints what became of a pair, which is one of `pairs`.
    fn put(
        &self,
        estimate: &Estimate,
        report: &Report,
        source: &[Point],
        [pair, pairs]: [usize; 2],
    ) -> Result<(), Failure> {
        let place = |path: &PathBuf| numbered(path, pair, pairs);
        let (output, picture) = (
            self.output.as_ref().map(place),
            self.picture.as_ref().map(place),
        );
        if let Some(path) = &output {
            write(estimate, source, path)?;
        }
        if let Some(path) = &picture {
            draw(estimate, source, path)?;
        }
        if self.json {
            let json = serde_json::to_string(report).map_err(Failure::internal)?;
            return say(format_args!("{json}"));
        }
        print_report(report)?;
        for path in output.iter().chain(&picture) {
            say(format_args!("  wrote {}", path.display()))?;
        }
        Ok(())
    }
}
