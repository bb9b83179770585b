//! Response time and accuracy under a deadline, for points off the ground.
//!
//! ```text
//! cargo bench --bench deadline -- PAIR.npz...
//! ```
#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]

use std::time::Instant;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{Truth, evaluate};
use fnsf::flow::field::Backend;
use fnsf::flow::{Control, Ground, Interrupt, Options, Preset, Problem, estimate};
use fnsf::formats::{Pair, read_pair};

const SEEDS: u64 = 5;
const DEADLINES_MS: [Option<u32>; 10] = [
    Some(0),
    Some(50),
    Some(100),
    Some(150),
    Some(200),
    Some(300),
    Some(500),
    Some(1000),
    Some(2000),
    None,
];

/// A clock with an optional deadline, seconds after its start.
struct Clock(Instant, Option<f64>);

impl Control for Clock {
    fn seconds(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }
    fn seconds_left(&self) -> Option<f64> {
        self.1.map(|deadline| deadline - self.seconds())
    }
    fn interrupt(&self) -> Option<Interrupt> {
        let late = self.seconds_left().is_some_and(|left| left <= 0.0);
        late.then_some(Interrupt::Deadline)
    }
}

/// The upper median of the values.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// One run: milliseconds, megabytes of the distance transform, iterations, EPE in metres, and EPE
/// of the moving points in metres.
type Figures = [f64; 5];

fn run(
    backend: &CpuBackend,
    pair: &Pair,
    options: &Options,
    deadline: Option<f64>,
) -> Result<(Figures, usize, &'static str), String> {
    let ground = pair.ground.as_ref().ok_or("the pair has no ground masks")?;
    let known = pair.truth.as_ref().ok_or("the pair has no truth")?;
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: Some([&ground.source, &ground.target]),
        times: None,
        before: None,
        neighbors: &[],
    };
    backend.host().clear_cache();
    let clock = Clock(Instant::now(), deadline);
    let estimate = estimate(backend, &problem, options, &clock).map_err(|e| e.to_string())?;
    let milliseconds = clock.seconds() * 1e3;
    let truth = Truth {
        dynamic: known.dynamic.as_deref(),
        ground: Some(&ground.source),
        ..Truth::new(&known.flow, &known.valid)
    };
    let metrics = evaluate(&estimate.flow, &estimate.valid, &truth).map_err(|e| e.to_string())?;
    let fit = estimate.fit();
    let figures = [
        milliseconds,
        fit.map_or(0.0, |fit| fit.distance_bytes as f64 / 1e6),
        fit.map_or(0.0, |fit| fit.iterations as f64),
        metrics.epe,
        metrics.epe_dynamic.unwrap_or(f64::NAN),
    ];
    Ok((figures, estimate.points, estimate.stop_reason.name()))
}

fn main() -> Result<(), String> {
    let backend = CpuBackend::new(Some(2)).map_err(|e| e.to_string())?;
    let paths = std::env::args().skip(1).filter(|path| path != "--bench");
    println!("medians of {SEEDS} seeds, all points fitted, 2 threads\n");
    println!(
        "| pair | preset | deadline ms | answered after ms (worst) | points | transform MB | iterations | end | EPE | EPE movers |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    for path in paths {
        let bytes = std::fs::read(&path).map_err(|e| format!("{path}: {e}"))?;
        let pair = read_pair(&bytes).map_err(|e| format!("{path}: {e}"))?;
        let name = path.trim_end_matches("/pair.npz").rsplit('/').next();
        let name = name.unwrap_or_default();
        for preset in Preset::ALL {
            for deadline in DEADLINES_MS {
                let mut runs = Vec::new();
                let (mut points, mut end) = (0, "");
                for seed in 0..SEEDS {
                    let mut options = preset.options(None);
                    options.ground = Ground::Mask;
                    options.seed = seed;
                    let left = deadline.map(|ms| f64::from(ms) / 1e3);
                    let figures;
                    (figures, points, end) = run(&backend, &pair, &options, left)?;
                    runs.push(figures);
                }
                let of = |figure: usize| median(runs.iter().map(|run| run[figure]).collect());
                let worst = runs.iter().map(|run| run[0]).fold(0.0, f64::max);
                println!(
                    "| {name} | {} | {} | {:.0} ({worst:.0}) | {points} | {:.0} | {:.0} | {end} | {:.4} | {:.3} |",
                    preset.name(),
                    deadline.map_or("none".to_owned(), |ms| ms.to_string()),
                    of(0),
                    of(1),
                    of(2),
                    of(3),
                    of(4)
                );
            }
        }
    }
    Ok(())
}
