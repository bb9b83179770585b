//! `fnsf flow`: scene flow of one pair, or of the consecutive pairs of a sequence.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::anyhow;
use clap::{Args, ValueEnum};

use super::estimation::{Estimation, Surroundings, check_sequence};
use super::failure::Failure;
use super::files;
use super::machine::peak_resident_bytes;
use super::output::say;
use super::terminal::Terminal;
use super::tracks::TrackArguments;
use crate::flow::{Control, Ego, Estimate, Point, Sequence, Sweep};
use crate::formats::{FlowFormat, FlowTable, write_flow};
use crate::job::{JobOptions, Report};
use crate::picture;
use crate::picture::{TopDown, TopDownOptions};
use crate::text::grouped;

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
    fnsf flow sweeps/*.pcd --preset label --tracks tracks.json --tracks-picture tracks.png")]
pub(super) struct Flow {
    /// The sweeps, two or more, in the order in which they were recorded; or one .npz file with two
    /// sweeps, as arrays pc1 and pc2
    #[arg(required = true, value_name = "SWEEP")]
    sweeps: Vec<PathBuf>,
    /// File for the flow. Its ending gives the format: .npz, .npy, .feather, .ply, .pcd or .json.
    /// With more than two sweeps the files are numbered: flow.npz becomes flow_0000.npz,
    /// flow_0001.npz, ...
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// File for a picture of the flow from above, colored by direction of motion; numbered likewise
    #[arg(long, value_name = "OUT.png")]
    picture: Option<PathBuf>,
    /// Print the report of each pair as one JSON object on stdout, instead of text
    #[arg(long)]
    json: bool,
    /// Lead sweeps whose points have times (a field offset_ns, t, time or timestamp of ply, pcd and
    /// feather) to one instant by the ego motion. auto: where the two sweeps of a pair then fit
    /// clearly better, which they do not if they were deskewed before. on: always. off: the times are
    /// not read. A deskewed flow starts from the deskewed points, and they are in the files that hold
    /// points. With times, objects move for the real time between their points
    #[arg(long, value_enum, default_value_t)]
    deskew: DeskewChoice,
    #[command(flatten)]
    tracks: TrackArguments,
    #[command(flatten)]
    estimation: Estimation,
}

/// Whether sweeps are deskewed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum DeskewChoice {
    /// Where the sweeps fit better then.
    #[default]
    Auto,
    /// Always.
    On,
    /// Never: each sweep counts as measured at one instant.
    Off,
}

/// A pair whose estimate is not complete, because its window may need later sweeps.
struct Waiting {
    pair: usize,
    source: Arc<[Point]>,
    target: Arc<[Point]>,
    /// Seconds spent on reading the target sweep.
    load: f64,
}

/// Writes the flow in the format given by the path's ending.
fn write(estimate: &Estimate, source: &[Point], path: &Path) -> Result<(), Failure> {
    let format = FlowFormat::from_path(path).map_err(Failure::usage)?;
    let table = FlowTable::new(source, estimate);
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
                .objects()
                .map_or(&[], |objects| objects.clusters.as_slice()),
        },
        &TopDownOptions::default(),
    );
    files::write(path, |file| picture::write_png(&image, file))
}

/// Prints a report as text.
pub(super) fn print_report(report: &Report) -> Result<(), Failure> {
    let seconds = &report.seconds;
    say(format_args!(
        "flow of {} points in {:.2} s on {}",
        grouped(report.valid_points),
        seconds.total,
        report.device
    ))?;
    let phases = [
        ("load", seconds.load),
        ("precompute", Some(seconds.precompute)),
        ("search", seconds.search),
        ("query", seconds.query),
        ("network", seconds.network),
    ];
    let phases = phases.into_iter();
    let phases = phases.filter_map(|(name, taken)| Some(format!("{name} {:.2} s", taken?)));
    say(format_args!("  {}", phases.collect::<Vec<_>>().join(", ")))?;
    let (preset, reason) = (&report.preset, &report.stop_reason);
    if let Some(objects) = &report.objects {
        let cost = objects.cost_m.map(|cost| format!(", cost {cost:.4} m"));
        let (clusters, moving, cost) = (objects.searched, objects.moving, cost.unwrap_or_default());
        say(format_args!(
            "  preset {preset}: {clusters} clusters, {moving} move ({reason}){cost}"
        ))?;
        if objects.own_points > 0 {
            say(format_args!(
                "  {} points of the vehicle itself have no flow",
                grouped(objects.own_points)
            ))?;
        }
    }
    if let Some(field) = &report.field {
        let unit = &field.loss_unit;
        let loss = field
            .best_loss
            .map(|loss| format!(", loss {loss:.4} {unit}"));
        let (seed, iterations, loss) = (report.seed, field.iterations, loss.unwrap_or_default());
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
    if let Some(covariance) = &report.ego_covariance {
        let deviation: [f64; 6] = core::array::from_fn(|a| covariance[a][a].max(0.0).sqrt());
        let [x, y, z] = [0, 1, 2].map(|a| 1e3 * deviation[a]);
        let [roll, pitch, yaw] = [3, 4, 5].map(|a| deviation[a].to_degrees());
        say(format_args!(
            "    certain to {x:.1}, {y:.1}, {z:.1} mm; roll, pitch, yaw to {roll:.3}, {pitch:.3}, {yaw:.3} degrees"
        ))?;
    }
    if let Some(deskew) = report.deskew {
        let [given, deskewed] = deskew.distance_m.map(|m| 100.0 * m);
        let outcome = match deskew.applied {
            true => "deskewed",
            false => "taken as they are",
        };
        say(format_args!(
            "  sweeps {outcome}: near points {given:.2} cm from the target as given, {deskewed:.2} cm deskewed"
        ))?;
    }
    for warning in &report.warnings {
        eprintln!("fnsf: warning: {warning}");
    }
    if let Some(overlap) = report.overlap {
        say(format_args!(
            "  overlap {:.0}% of the source",
            100.0 * overlap
        ))?;
    }
    Ok(())
}

/// `path` with the pair's number before the ending, where there are several pairs.
fn numbered(path: &Path, pair: usize, pairs: usize) -> PathBuf {
    if pairs < 2 {
        return path.to_owned();
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}_{pair:04}.{ending}"))
}

/// The input sweeps: files, which are read one by one, or the two sweeps of one file.
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
                let sweep = |points, ground| Sweep {
                    points,
                    ground,
                    times: None,
                };
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
        let mut tracking = self.tracks.start(sweeps.count(), &options)?;
        let mut surroundings = self.estimation.surroundings(&self.sweeps)?;
        self.check_deskew(&surroundings, &options)?;
        let mut device = self.estimation.open()?;
        let mut sequence = Sequence::default();
        // The pairs that are not complete, and the points of the last sweep.
        let mut waiting: VecDeque<Waiting> = VecDeque::new();
        let mut last = None::<Arc<[Point]>>;
        let count = sweeps.count();
        for index in 0..count {
            let began = terminal.seconds();
            let sweep = match &sweeps {
                Sweeps::Pair(pair) => pair[index].clone(),
                Sweeps::Files(files) => self.read(&mut surroundings, index, &files[index])?,
            };
            let load = terminal.seconds() - began;
            let points: Arc<[Point]> = sweep.points.as_slice().into();
            let larger = points.len().max(last.as_ref().map_or(0, |last| last.len()));
            let pair = [index.saturating_sub(1), index];
            let mut solver_options = surroundings.options(&options, larger, pair);
            solver_options.always_deskew = self.deskew == DeskewChoice::On;
            if let Some(source) = last.replace(Arc::clone(&points)) {
                waiting.push_back(Waiting {
                    pair: pair[0],
                    source,
                    target: points,
                    load,
                });
            }
            let mut found = device.push(&mut sequence, &sweep, &solver_options, &terminal)?;
            // Complete pairs are written before the next one is estimated, which may fail.
            loop {
                terminal.finish();
                let complete = waiting.drain(..found.len());
                for (estimate, pair) in found.iter_mut().zip(complete) {
                    let options = surroundings.timed(&options, [pair.pair, pair.pair + 1]);
                    let [source, target] = estimate.sweeps([&pair.source, &pair.target]);
                    if let Some(tracking) = &mut tracking {
                        let dt_s = options.solver_options(0).dt_s;
                        tracking.push([&source, &target], estimate, dt_s)?;
                    }
                    let mut report = Report::new(estimate, &options);
                    report.seconds.load = Some(pair.load);
                    report.seconds.total += pair.load;
                    report.peak_rss_bytes = peak_resident_bytes();
                    self.put(estimate, &report, &source, [pair.pair, count - 1])?;
                }
                if index + 1 < count {
                    break;
                }
                found = device.finish(&mut sequence, &terminal)?;
                if found.is_empty() {
                    break;
                }
            }
        }
        tracking.map_or(Ok(()), |tracking| tracking.finish(self.json))
    }

    /// Reads a sweep, with the times of its points unless they are not asked for.
    fn read(
        &self,
        surroundings: &mut Surroundings,
        index: usize,
        path: &Path,
    ) -> Result<Sweep, Failure> {
        if self.deskew == DeskewChoice::Off {
            return surroundings.sweep(index, path);
        }
        let sweep = surroundings.timed_sweep(index, path)?;
        if self.deskew == DeskewChoice::On && sweep.times.is_none() {
            let path = path.display();
            return Err(Failure::usage(anyhow!(
                "{path}: its points have no times, which --deskew on needs"
            )));
        }
        Ok(sweep)
    }

    /// Refuses `--deskew on` where no sweep could be deskewed.
    fn check_deskew(
        &self,
        surroundings: &Surroundings,
        options: &JobOptions,
    ) -> Result<(), Failure> {
        let refused = if self.deskew != DeskewChoice::On {
            return Ok(());
        } else if self.sweeps.len() < 2 {
            "the sweeps of an .npz pair have no times, which --deskew on needs"
        } else if surroundings.options(options, 0, [0, 1]).ego == Ego::Off {
            "--deskew on needs the ego motion: give --ego auto, or --poses"
        } else {
            return Ok(());
        };
        Err(Failure::usage(anyhow!(refused)))
    }

    /// Refuses outputs that could not be written. Called before any work.
    fn check_outputs(&self) -> Result<(), Failure> {
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
        let pairs = self.sweeps.len().saturating_sub(1).max(1);
        let named = [&self.output, &self.picture].into_iter().flatten();
        let outputs: Vec<PathBuf> = named
            .flat_map(|path| (0..pairs).map(|pair| numbered(path, pair, pairs)))
            .chain(tracks)
            .collect();
        let known = self.estimation.files();
        files::check_outputs(&outputs, self.sweeps.iter().chain(&known))
    }

    /// Writes, draws and prints the estimate of number `pair` of `pairs` pairs.
    fn put(
        &self,
        estimate: &Estimate,
        report: &Report,
        source: &[Point],
        [pair, pairs]: [usize; 2],
    ) -> Result<(), Failure> {
        let index = |path: &PathBuf| numbered(path, pair, pairs);
        let (output, picture) = (
            self.output.as_ref().map(index),
            self.picture.as_ref().map(index),
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
