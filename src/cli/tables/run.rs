//! The `tables` command.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;
use serde::Serialize;

use super::cells::{Ablation, CellFigures};
use super::devices::Devices;
use super::figures::Figures;
use super::measure::{Budget, Subject, measure};
use super::rows::{ALL, Row, names};
use super::{plots, print};
use crate::cli::device::DeviceArgument;
use crate::cli::failure::Failure;
use crate::cli::files;
use crate::cli::output::{say, tell};
use crate::cli::terminal::Terminal;
use crate::flow::{Ego, Options};
use crate::formats::Pair;
use crate::job::{GroundChoice, JobOptions};

/// Compare the methods of the FNSF paper on pairs with ground truth.
///
/// Each method estimates the flow of each pair and is scored by the paper's metrics. The points are
/// those off the ground, where the pair has ground masks, and all points otherwise. With
/// --max-points both clouds are sampled. Times are wall-clock seconds of this machine, from points in
/// memory to flow in memory.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf tables pair.npz --max-points 8192\n  \
    fnsf tables a.npz b.npz --only fnsf,nsfp-kdtree --seeds 5 --csv rows.csv --plots .\n  \
    fnsf tables pair.npz --only fnsf --cells --budget 600\n\n\
    Methods: fnsf, fnsf-linear, nsfp, nsfp-baseline, nsfp-kdtree, nsfp-linear, nsfp-kdtree-linear,\n  \
    nsfp++, nsfp++-dt, fnsf-sampled-time, fnsf-sampled-loss, nsfp-kdtree-every-5, default")]
pub(crate) struct Tables {
    /// Pairs as .npz with `pc1`, `pc2` and the true `flow`; the files that FNSF's authors publish
    /// are such pairs
    #[arg(required = true, value_name = "PAIR")]
    pairs: Vec<PathBuf>,
    /// Methods to run, separated by commas; all by default
    #[arg(long, value_name = "METHOD", value_delimiter = ',', value_parser = method)]
    only: Vec<&'static str>,
    /// Number of runs of each method, with the seeds 0 to N - 1. The figures are medians
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=1000))]
    seeds: u16,
    /// Sample this many points of each cloud, at least 3. All points by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(3..))]
    max_points: Option<u32>,
    /// Half the side of a square crop about the sensor, metres. No crop by default
    #[arg(long, value_name = "R")]
    crop_m: Option<f32>,
    /// Ground points. By default they are left out by the pair's masks where it has them, else they
    /// take part
    #[arg(long, value_enum)]
    ground: Option<GroundChoice>,
    /// Ends each run after this many seconds with its best flow so far, and marks it as cut. No
    /// limit by default
    #[arg(long, value_name = "SECONDS")]
    budget: Option<f64>,
    /// Also runs fnsf with cells of 1, 0.5, 0.33, 0.2, 0.1, 0.05, 0.02 and 0.01 m
    #[arg(long)]
    cells: bool,
    /// Runs --cells in bird's eye view, as the paper's ablation
    #[arg(long, requires = "cells")]
    bev: bool,
    /// Device for the methods that have kernels for a GPU: cpu, gpu or gpu:CARD, as with fnsf flow.
    /// The others are computed on the CPU. JSON and CSV name the device of each
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: DeviceArgument,
    /// CPU threads, 1 to 256; all cores by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// Writes the figures as CSV
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Writes the figures as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Writes plots as SVG to this folder, which must exist: time against error, and with --cells
    /// error, time and memory against cell size
    #[arg(long, value_name = "FOLDER")]
    plots: Option<PathBuf>,
}

fn method(name: &str) -> Result<&'static str, String> {
    let found = Row::named(name).map(|row| row.name);
    found.ok_or_else(|| format!("{name:?} is none of {}", names()))
}

/// Reads a pair with both clouds and the truth.
fn read(path: &Path) -> Result<Subject, Failure> {
    let (truth, pair) = files::read_truth(path)?;
    let name = path.display().to_string();
    if pair.source.is_empty() {
        let why = format!("{name} has labels alone: a pair with pc1, pc2 and flow is needed");
        return Err(Failure::usage(anyhow!(why)));
    }
    Ok(Subject { name, pair, truth })
}

/// Points of the larger cloud.
fn largest(pair: &Pair) -> usize {
    pair.source.len().max(pair.target.len())
}

/// All figures, as `--json` writes them.
#[derive(Serialize)]
struct Document<'a> {
    /// Version of the program.
    version: &'static str,
    methods: &'a [Figures],
    cells: &'a [CellFigures],
}

impl Tables {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        self.check()?;
        let devices = Devices::open(&self.device, self.threads.map(usize::from))?;
        let terminal = Terminal::new();
        let mut methods = Vec::new();
        let mut cells = Vec::new();
        for path in &self.pairs {
            let mut subject = read(path)?;
            let found = self.measure_methods(&devices, &subject, &terminal)?;
            methods.extend(found);
            if self.cells {
                if self.bev {
                    let flows = subject.truth.flow.iter_mut();
                    flows.for_each(|flow| flow[2] = 0.0);
                }
                let ablation = Ablation {
                    devices: &devices,
                    bev: self.bev,
                    budget: self.budget,
                    complete: &|options| self.complete(options, &subject.pair, 0),
                    terminal: &terminal,
                    writes: self.writes(),
                };
                cells.extend(ablation.run(&subject)?);
            }
        }
        self.write(&methods, &cells)
    }

    /// Whether the tables are written to files too.
    fn writes(&self) -> bool {
        let files = [&self.csv, &self.json, &self.plots];
        files.into_iter().any(Option::is_some)
    }

    /// Runs the methods on one pair and prints each row when it is known.
    fn measure_methods(
        &self,
        devices: &Devices,
        subject: &Subject,
        terminal: &Terminal,
    ) -> Result<Vec<Figures>, Failure> {
        let Subject { name, pair, .. } = subject;
        let mut all = Vec::new();
        terminal.finish();
        tell(self.writes(), format_args!("\n{name}\n"))?;
        print::heading(self.writes())?;
        let chosen = |row: &Row| self.only.is_empty() || self.only.contains(&row.name);
        for row in ALL.into_iter().filter(chosen) {
            let mut runs = Vec::new();
            for seed in 0..self.seeds {
                terminal.part(&format!("{name}, {}, seed {seed}", row.name));
                let drawn = self.max_points.map_or(usize::MAX, |points| points as usize);
                let options = row.options(drawn.min(largest(pair)));
                let options = self.complete(&options, pair, seed.into());
                let control = Budget::new(self.budget, terminal);
                let run = measure(devices, subject, &options, &control);
                let what = || format!("{name}, {}", row.name);
                runs.push(run.map_err(|error| match error.is_input() {
                    true => Failure::bad_input(anyhow!(error).context(what())),
                    false => Failure::internal(anyhow!(error).context(what())),
                })?);
            }
            let figures = Figures::new(name, &row, &runs);
            terminal.finish();
            print::row(self.writes(), &figures)?;
            all.push(figures);
        }
        Ok(all)
    }

    /// The solver's options, with what the pair and the command line decide for every method.
    fn complete(&self, options: &JobOptions, pair: &Pair, seed: u64) -> Options {
        let preset = options.preset.preset().options(None);
        let by_masks = match preset.ego {
            Ego::Off => GroundChoice::Mask,
            // With an ego motion, the ground stays with the registration.
            _ => GroundChoice::Auto,
        };
        let usual = match pair.ground {
            Some(_) => by_masks,
            None => GroundChoice::Keep,
        };
        let options = JobOptions {
            seed,
            max_points: self.max_points,
            crop_m: self.crop_m,
            ground: Some(self.ground.unwrap_or(usual)),
            ..options.clone()
        };
        options.solver_options(largest(pair))
    }

    fn check(&self) -> Result<(), Failure> {
        let positive = |name: &str, value: Option<f64>| match value {
            Some(value) if !(value.is_finite() && value > 0.0) => Err(Failure::usage(anyhow!(
                "--{name} {value}: a number above 0 is needed"
            ))),
            _ => Ok(()),
        };
        positive("budget", self.budget)?;
        positive("crop-m", self.crop_m.map(f64::from))?;
        if let Some(folder) = self.plots.as_deref().filter(|folder| !folder.is_dir()) {
            let folder = folder.display();
            return Err(Failure::usage(anyhow!(
                "--plots {folder}: there is no such folder"
            )));
        }
        let outputs = [&self.csv, &self.json].into_iter().flatten();
        files::check_outputs(outputs, &self.pairs)
    }

    fn write(&self, methods: &[Figures], cells: &[CellFigures]) -> Result<(), Failure> {
        let wrote = |path: &Path| say(format_args!("wrote {}", path.display()));
        if let Some(path) = &self.csv {
            files::write(path, |file| print::write_csv(methods, file))?;
            wrote(path)?;
        }
        if let Some(path) = &self.json {
            let document = Document {
                version: env!("CARGO_PKG_VERSION"),
                methods,
                cells,
            };
            files::write(path, |file| serde_json::to_writer_pretty(file, &document))?;
            wrote(path)?;
        }
        if let Some(folder) = &self.plots {
            plots::write(folder, methods, cells)?;
            wrote(folder)?;
        }
        Ok(())
    }
}
