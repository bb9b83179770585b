//! `fnsf flow`: one pair, here and now.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::failure::Failure;
use super::files;
use super::machine::{Device, peak_resident_bytes};
use super::output::say;
use super::terminal::Terminal;
use crate::flow::{self, Ego, Estimate, Ground, Options, Preset, Problem, Watch};
use crate::formats::{FlowFormat, FlowTable, Pair, matrix_rows, write_flow};
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
    pub(super) estimation: Estimation,
}

/// How the flow is found.
#[derive(Clone, Debug, Args)]
pub(super) struct Estimation {
    /// default: ours, robust and fast; paper: FNSF as published
    #[arg(long, value_name = "NAME", default_value = "default", value_parser = preset)]
    preset: Preset,
    /// Where the work is done
    #[arg(long, value_enum, default_value_t = Device::Auto)]
    device: Device,
    /// CPU threads; all cores by default. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// The same seed gives the same bits
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(super) seed: u64,
    /// Draw this many points from each cloud and leave out the rest
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(3..))]
    max_points: Option<u32>,
    /// Leave out points with |x| or |y| beyond R metres
    #[arg(long, value_name = "R", value_parser = positive)]
    range_m: Option<f32>,
    /// Keep ground points, or leave out those that the pair's ground1 and ground2 name; keep by
    /// default, but mask in the demo
    #[arg(long, value_enum)]
    ground: Option<GroundChoice>,
    /// The vehicle's own motion: off, auto (estimate it first), or a file with the 4 x 4 matrix
    /// target_from_source; by default what the preset does
    #[arg(long, value_name = "off|auto|FILE")]
    ego: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum GroundChoice {
    Keep,
    Mask,
}

fn preset(name: &str) -> Result<Preset, String> {
    let known = || Preset::ALL.map(Preset::name).join(", ");
    let found = Preset::ALL.into_iter().find(|preset| preset.name() == name);
    found.ok_or_else(|| format!("known presets: {}", known()))
}

fn positive(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("a positive number of metres is needed".to_owned()),
    }
}

impl Estimation {
    fn options(&self, pair: &Pair) -> Result<Options, Failure> {
        let all = pair.source.len().max(pair.target.len());
        let drawn = self.max_points.map(|points| points as usize);
        let mut options = self.preset.options(drawn.filter(|&points| points < all));
        options.seed = self.seed;
        options.range_m = self.range_m;
        options.ground = match self.ground {
            None | Some(GroundChoice::Keep) => Ground::Keep,
            Some(GroundChoice::Mask) => Ground::Mask,
        };
        match self.ego.as_deref() {
            None => {}
            Some("off") => options.ego = Ego::Off,
            Some("auto") => options.ego = Ego::Auto,
            Some(file) => options.ego = Ego::Given(files::read_motion(Path::new(file))?),
        }
        Ok(options)
    }

    /// Leaves ground out unless it is asked for.
    pub(super) fn masking_ground(mut self) -> Self {
        self.ground.get_or_insert(GroundChoice::Mask);
        self
    }

    /// Estimates the pair's flow; `began` is when loading began, by the terminal's clock.
    pub(super) fn solve(&self, pair: &Pair, began: &Loading) -> Result<Solved, Failure> {
        let options = self.options(pair)?;
        let load = began.terminal.seconds();
        let backend = self
            .device
            .open(self.threads.map(usize::from))
            .map_err(Failure::internal)?;
        let ground = pair.ground.as_ref();
        let problem = Problem {
            source: &pair.source,
            target: &pair.target,
            ground: ground.map(|ground| [ground.source.as_slice(), ground.target.as_slice()]),
        };
        let estimate = flow::estimate(backend.as_ref(), &problem, &options, &began.terminal);
        began.terminal.finish();
        let estimate = estimate?;
        let report = self.report(&estimate, backend.name(), load);
        Ok(Solved { estimate, report })
    }

    fn report(&self, estimate: &Estimate, device: String, load: f64) -> Report {
        let seconds = estimate.seconds;
        Report {
            points: estimate.points,
            iterations: estimate.iterations,
            best_iteration: estimate.best_iteration,
            best_loss: estimate.best_loss,
            stop_reason: estimate.stop_reason.name(),
            device,
            preset: self.preset.name(),
            seed: self.seed,
            ego_motion: estimate.ego.as_ref().map(matrix_rows),
            seconds: Seconds {
                load,
                precompute: seconds.precompute,
                query: seconds.query,
                network: seconds.network,
                total: load + seconds.total,
            },
            peak_rss_bytes: peak_resident_bytes(),
        }
    }
}

/// The clock and the bar, started before the first file is read.
pub(super) struct Loading {
    terminal: Terminal,
}

impl Loading {
    pub(super) fn begin() -> Self {
        Self {
            terminal: Terminal::new(),
        }
    }
}

/// A solved pair and what it took.
pub(super) struct Solved {
    pub(super) estimate: Estimate,
    pub(super) report: Report,
}

impl Solved {
    /// Writes the flow in the format that the name asks for.
    pub(super) fn write(&self, pair: &Pair, path: &Path) -> Result<(), Failure> {
        let format = FlowFormat::from_path(path).map_err(Failure::usage)?;
        let estimate = &self.estimate;
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
    pub(super) fn draw(&self, pair: &Pair, path: &Path) -> Result<(), Failure> {
        let estimate = &self.estimate;
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
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    points: usize,
    iterations: usize,
    best_iteration: usize,
    best_loss: f64,
    stop_reason: &'static str,
    device: String,
    preset: &'static str,
    seed: u64,
    ego_motion: Option<[[f64; 4]; 4]>,
    pub(super) seconds: Seconds,
    peak_rss_bytes: Option<u64>,
}

/// Wall-clock seconds by phase.
#[derive(Debug, Serialize)]
pub(super) struct Seconds {
    load: f64,
    precompute: f64,
    query: f64,
    network: f64,
    pub(super) total: f64,
}

impl Report {
    /// What a person reads.
    pub(super) fn print(&self) -> Result<(), Failure> {
        let seconds = &self.seconds;
        say(format_args!(
            "flow of {} points in {:.2} s on {}",
            grouped(self.points),
            seconds.total,
            self.device
        ))?;
        say(format_args!(
            "  load {:.2} s, precompute {:.2} s, query {:.2} s, network {:.2} s",
            seconds.load, seconds.precompute, seconds.query, seconds.network
        ))?;
        say(format_args!(
            "  preset {}, seed {}: {} iterations ({}), loss {:.4} m",
            self.preset, self.seed, self.iterations, self.stop_reason, self.best_loss
        ))?;
        if let Some(motion) = self.ego_motion {
            let [x, y, z] = [motion[0][3], motion[1][3], motion[2][3]];
            say(format_args!(
                "  ego motion {x:.3}, {y:.3}, {z:.3} m (target from source)"
            ))?;
        }
        Ok(())
    }
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
        let loading = Loading::begin();
        let pair = match &self.target {
            None => files::read_pair(&self.source)?,
            Some(target) => Pair {
                source: files::read_cloud(&self.source)?,
                target: files::read_cloud(target)?,
                ..Pair::default()
            },
        };
        let solved = self.estimation.solve(&pair, &loading)?;
        if let Some(path) = &self.output {
            solved.write(&pair, path)?;
        }
        if let Some(path) = &self.picture {
            solved.draw(&pair, path)?;
        }
        if self.json {
            let json = serde_json::to_string(&solved.report).map_err(Failure::internal)?;
            say(format_args!("{json}"))?;
        } else {
            solved.report.print()?;
            for path in self.output.iter().chain(&self.picture) {
                say(format_args!("  wrote {}", path.display()))?;
            }
        }
        Ok(())
    }
}
