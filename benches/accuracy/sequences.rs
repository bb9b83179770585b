//! Cost and accuracy of the warm-started pairs of a sequence, compared with the same pairs alone:
//! rows of `docs/experiments/sequences.md`.
//!
//! ```text
//! cargo bench --bench accuracy -- sequences [SWEEP...]
//! ```
//!
//! Simulated streets have exact ground truth. For the given sweeps, if any, the remaining loss is
//! reported.

use std::time::Instant;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::field::Backend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{
    Estimate, Options, Point, Preset, Problem, Sequence, Sweep, Uncontrolled, WarmStart, estimate,
};
use fnsf::formats::read_cloud;

/// Number of sweeps of a simulated drive.
const FRAMES: usize = 8;

/// A drive, and for each pair the true flow, dynamic flags and ground flags, if known.
struct Drive {
    name: String,
    sweeps: Vec<Vec<Point>>,
    truth: Vec<Truth>,
}

struct Truth {
    flow: Vec<Point>,
    dynamic: Vec<bool>,
    ground: Vec<bool>,
}

/// Sums over the pairs of a drive. Errors are end-point errors off the ground in metres: of all
/// points, the moving points and the static points.
#[derive(Default)]
struct Sums {
    errors: [f64; 3],
    counts: [f64; 3],
    seconds: f64,
    iterations: usize,
    pairs: usize,
    loss: f64,
}

impl Sums {
    fn add(&mut self, estimate: &Estimate, truth: Option<&Truth>, seconds: f64) {
        self.pairs += 1;
        self.seconds += seconds;
        self.iterations += estimate.fit().expect("a fit").iterations;
        self.loss += estimate.fit().expect("a fit").best_loss;
        let Some(truth) = truth else { return };
        for (row, flow) in estimate.flow.iter().enumerate() {
            if truth.ground[row] || !estimate.valid[row] {
                continue;
            }
            let square: f64 = (0..3)
                .map(|a| f64::from(flow[a] - truth.flow[row][a]).powi(2))
                .sum();
            let class = if truth.dynamic[row] { 1 } else { 2 };
            for class in [0, class] {
                self.errors[class] += square.sqrt();
                self.counts[class] += 1.0;
            }
        }
    }

    fn print(&self, name: &str, variant: &str) {
        let [all, movers, still] = [0, 1, 2].map(|c| self.errors[c] / self.counts[c]);
        let pairs = self.pairs as f64;
        println!(
            "| {name} | {variant} | {all:.4} | {movers:.3} | {still:.4} | {:.4} | {:.0} | {:.3} |",
            self.loss / pairs,
            self.iterations as f64 / pairs,
            self.seconds / pairs,
        );
    }
}

fn simulated(seed: u64) -> anyhow::Result<Drive> {
    let street = Street::new(&StreetOptions {
        seed,
        sweeps: FRAMES,
        ..StreetOptions::default()
    })?;
    let sweeps = (0..FRAMES).map(|k| street.sweep(k));
    let sweeps = sweeps.collect::<Result<Vec<_>, _>>()?;
    let truth = (0..FRAMES - 1).map(|k| {
        let pair = street.pair(k)?;
        anyhow::Ok(Truth {
            flow: pair.flow,
            dynamic: pair.dynamic,
            ground: pair.ground_source,
        })
    });
    Ok(Drive {
        name: format!("street {seed}"),
        truth: truth.collect::<Result<_, _>>()?,
        sweeps: sweeps.into_iter().map(|frame| frame.points).collect(),
    })
}

fn alone(backend: &CpuBackend, drive: &Drive, options: &Options) -> anyhow::Result<Sums> {
    let mut sums = Sums::default();
    for (k, pair) in drive.sweeps.windows(2).enumerate() {
        let problem = Problem::pair(&pair[0], &pair[1]);
        backend.host().clear_cache();
        let began = Instant::now();
        let estimate = estimate(backend, &problem, options, &Uncontrolled)?;
        let seconds = began.elapsed().as_secs_f64();
        // The first pair of a sequence has no warm start, so only the others are compared.
        if k > 0 {
            sums.add(&estimate, drive.truth.get(k), seconds);
        }
    }
    Ok(sums)
}

fn in_sequence(backend: &CpuBackend, drive: &Drive, options: &Options) -> anyhow::Result<Sums> {
    let mut sums = Sums::default();
    let mut sequence = Sequence::default();
    backend.host().clear_cache();
    for (k, points) in drive.sweeps.iter().enumerate() {
        let sweep = Sweep {
            points: points.clone(),
            ground: None,
            ..Sweep::default()
        };
        let began = Instant::now();
        let estimates = sequence.push(backend, sweep, options, &Uncontrolled)?;
        let seconds = began.elapsed().as_secs_f64();
        if let [estimate] = estimates.as_slice()
            && k > 1
        {
            sums.add(estimate, drive.truth.get(k - 1), seconds);
        }
    }
    Ok(sums)
}

pub(super) fn run(arguments: Vec<String>) -> anyhow::Result<()> {
    let mut drives = (0..4).map(simulated).collect::<Result<Vec<_>, _>>()?;
    let paths: Vec<String> = arguments.into_iter().collect();
    if !paths.is_empty() {
        let read =
            |path: &String| anyhow::Ok(read_cloud(&std::fs::read(path)?, Some(path))?.points);
        drives.push(Drive {
            name: "drive".to_owned(),
            sweeps: paths.iter().map(read).collect::<Result<_, _>>()?,
            truth: Vec::new(),
        });
    }
    let backend = CpuBackend::new(None)?;
    let options = Preset::Neural.options(None);
    println!("| drive | pairs | EPE | EPE moving | EPE still | loss | iterations | s |");
    println!("|---|---|---|---|---|---|---|---|");
    for drive in &drives {
        alone(&backend, drive, &options)?.print(&drive.name, "alone");
        for (max_iterations, learning_rate) in [
            (40, 0.004),
            (60, 0.003),
            (75, 0.002),
            (75, 0.004),
            (150, 0.004),
        ] {
            let mut options = options.clone();
            options.field_mut().expect("a field").warm_start = Some(WarmStart {
                max_iterations,
                learning_rate,
            });
            let variant = format!("warm, {max_iterations} iterations from {learning_rate}");
            in_sequence(&backend, drive, &options)?.print(&drive.name, &variant);
        }
    }
    Ok(())
}
