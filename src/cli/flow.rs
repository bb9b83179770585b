//! `fnsf flow`: one pair, here and now.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;

use super::device::{self, DeviceArgument};
use super::failure::Failure;
use super::files;
use super::machine::peak_resident_bytes;
use super::output::say;
use super::terminal::Terminal;
use crate::flow::backend::BackendError;
use crate::flow::{self, Estimate, FlowError, Problem, Watch};
use crate::formats::{FlowFormat, FlowTable, Pair, write_flow};
use crate::job::{
    DeviceChoice, EgoChoice, GroundChoice, JobOptions, PrecisionChoice, PresetChoice, Report,
};
use crate::picture::{self, TopDown, TopDownOptions};
use crate::text::grouped;

/// Estimate the motion of every point between two sweeps.
///
/// Reads npz, npy, ply, pcd, KITTI bin, nuScenes pcd.bin and Argoverse 2 feather, recognized by
/// content. The flow has one row per source point: where the point is in the target's frame, less
/// where it was in the source's, in metres.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf flow a.feather b.feather -o flow.npz\n  \
    fnsf flow pair.npz --ground mask --range-m 51.2 -o flow.ply --picture flow.png\n  \
    fnsf flow a.pcd b.pcd --preset paper --max-points 8192 --json")]
pub(super) struct Flow {
    /// The earlier sweep; or an .npz with both, as arrays pc1 and pc2
    source: PathBuf,
    /// The later sweep
    target: Option<PathBuf>,
    /// Where the flow goes: .npz, .npy, .feather, .ply, .pcd or .json
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Draw the flow from above, colored by direction
    #[arg(long, value_name = "OUT.png")]
    picture: Option<PathBuf>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    estimation: Estimation,
}

/// How the flow is found.
#[derive(Clone, Debug, Args)]
struct Estimation {
    /// default: ours, robust and fast; paper: FNSF as published; label: movers found object by
    /// object, everything else still
    #[arg(long, value_enum, default_value_t)]
    preset: PresetChoice,
    /// Where the work is done: auto (a GPU, else the CPU), cpu, gpu, or gpu:CARD with a card's
    /// number, PCI id or part of its name; fnsf doctor lists them
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceArgument,
    /// CPU threads; all cores by default. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// What the network's products are rounded to: f16 is for GPUs whose matrix units pass their
    /// self-test, see fnsf doctor
    #[arg(long, value_enum, default_value_t)]
    precision: PrecisionChoice,
    /// The same seed gives the same bits
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Draw this many points from each cloud and leave out the rest
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(3..))]
    max_points: Option<u32>,
    /// Leave out points with |x| or |y| beyond R metres
    #[arg(long, value_name = "R", value_parser = positive)]
    range_m: Option<f32>,
    /// Keep ground points, leave out those that the pair's ground1 and ground2 name (mask), or find
    /// them and let them move with the vehicle's own motion (auto)
    #[arg(long, value_enum, default_value_t)]
    ground: GroundChoice,
    /// The vehicle's own motion: off, auto (estimate it first), or a file with the 4 x 4 matrix
    /// target_from_source; by default what the preset does
    #[arg(long, value_name = "off|auto|FILE")]
    ego: Option<String>,
}

fn positive(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("a positive number of metres is needed".to_owned()),
    }
}

impl Estimation {
    /// The same options that a request has.
    fn options(&self) -> Result<JobOptions, Failure> {
        let ego = match self.ego.as_deref() {
            None => None,
            Some("off") => Some(EgoChoice::Off),
            Some("auto") => Some(EgoChoice::Auto),
            Some(file) => Some(EgoChoice::Given(files::read_motion(Path::new(file))?)),
        };
        Ok(JobOptions {
            preset: self.preset,
            seed: self.seed,
            max_points: self.max_points,
            range_m: self.range_m,
            ground: self.ground,
            ego,
            device: self.device.choice,
            precision: self.precision,
            ..JobOptions::default()
        })
    }

    /// Estimates the pair's flow; `terminal` was started before the first file was read.
    fn solve(&self, pair: &Pair, terminal: &Terminal) -> Result<(Estimate, Report), Failure> {
        let options = self.options()?;
        let load = terminal.seconds();
        let threads = self.threads.map(usize::from);
        let mut backend = device::open(&self.device, threads)?;
        let ground = pair.ground.as_ref();
        let problem = Problem {
            source: &pair.source,
            target: &pair.target,
            ground: ground.map(|ground| [ground.source.as_slice(), ground.target.as_slice()]),
        };
        let points = pair.source.len().max(pair.target.len());
        let solver_options = options.solver_options(points);
        let mut estimate = flow::estimate(backend.as_ref(), &problem, &solver_options, terminal);
        if let Err(FlowError::Backend(error @ BackendError::Memory { .. })) = &estimate
            && self.device.choice == DeviceChoice::Auto
        {
            device::stand_in(error);
            backend = device::cpu(threads)?;
            estimate = flow::estimate(backend.as_ref(), &problem, &solver_options, terminal);
        }
        terminal.finish();
        let estimate = estimate?;
        let mut report = Report::new(
            &estimate,
            &options,
            solver_options.max_iterations,
            backend.name(),
        );
        report.seconds.load = Some(load);
        report.seconds.total += load;
        report.peak_rss_bytes = peak_resident_bytes();
        Ok((estimate, report))
    }
}

/// Writes the flow in the format that the name asks for.
fn write(estimate: &Estimate, pair: &Pair, path: &Path) -> Result<(), Failure> {
    let format = FlowFormat::from_path(path).map_err(Failure::usage)?;
    let table = FlowTable {
        source: &pair.source,
        flow: &estimate.flow,
        valid: &estimate.valid,
        dynamic: estimate.dynamic.as_deref(),
        ego: estimate.ego.as_ref(),
    };
    files::write(path, |file| write_flow(format, &table, file))
}

/// Draws the flow from above.
fn draw(estimate: &Estimate, pair: &Pair, path: &Path) -> Result<(), Failure> {
    let image = picture::top_down(
        &TopDown {
            source: &pair.source,
            flow: &estimate.flow,
            valid: &estimate.valid,
            ego: estimate.ego.as_ref(),
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
    say(format_args!(
        "  {}precompute {:.2} s, query {:.2} s, network {:.2} s",
        load.unwrap_or_default(),
        seconds.precompute,
        seconds.query,
        seconds.network
    ))?;
    let loss = report.best_loss.map(|loss| format!(", loss {loss:.4} m"));
    say(format_args!(
        "  preset {}, seed {}: {} iterations ({}){}",
        report.preset,
        report.seed,
        report.iterations,
        report.stop_reason,
        loss.unwrap_or_default()
    ))?;
    if let Some(motion) = report.ego_motion {
        let [x, y, z] = [motion[0][3], motion[1][3], motion[2][3]];
        say(format_args!(
            "  ego motion {x:.3}, {y:.3}, {z:.3} m (target from source)"
        ))?;
    }
    Ok(())
}

impl Flow {
    pub(super) fn run(&self) -> Result<(), Failure> {
        if self.output.is_none() && self.picture.is_none() && !self.json {
            return Err(Failure::usage(anyhow!(
                "nothing to do: give -o OUT, --picture OUT.png or --json"
            )));
        }
        if let Some(output) = &self.output {
            FlowFormat::from_path(output).map_err(Failure::usage)?;
            files::check_writable(output)?;
        }
        if let Some(picture) = &self.picture {
            if picture.extension().is_none_or(|ending| ending != "png") {
                return Err(Failure::usage(anyhow!("a picture's name ends in .png")));
            }
            files::check_writable(picture)?;
        }
        let terminal = Terminal::new();
        let pair = match &self.target {
            None => files::read_pair(&self.source)?,
            Some(target) => Pair {
                source: files::read_cloud(&self.source)?,
                target: files::read_cloud(target)?,
                ..Pair::default()
            },
        };
        let (estimate, report) = self.estimation.solve(&pair, &terminal)?;
        if let Some(path) = &self.output {
            write(&estimate, &pair, path)?;
        }
        if let Some(path) = &self.picture {
            draw(&estimate, &pair, path)?;
        }
        if self.json {
            let json = serde_json::to_string(&report).map_err(Failure::internal)?;
            say(format_args!("{json}"))?;
        } else {
            print_report(&report)?;
            for path in self.output.iter().chain(&self.picture) {
                say(format_args!("  wrote {}", path.display()))?;
            }
        }
        Ok(())
    }
}
