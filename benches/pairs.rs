//! Whole pairs: every preset at several sizes, on all cores.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench pairs
//! ```
#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]

mod common;

use std::time::Instant;

use common::{median, scenes};
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::field::Backend;
use fnsf::flow::{Control, Estimate, Options, Preset, Problem, estimate};

const SEEDS: u64 = 3;

/// A clock for the numerics.
struct Clock(Instant);

impl Control for Clock {
    fn seconds(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }
}

/// Seconds of the distance queries of a field; zero of an object search.
fn queries(estimate: &Estimate) -> f64 {
    estimate.fit().map_or(0.0, |fit| fit.query_seconds)
}

fn main() -> Result<(), String> {
    let backend = CpuBackend::new(None).map_err(|e| e.to_string())?;
    println!("{}; medians of {SEEDS} seeds, seconds\n", backend.name());
    println!("| scene | points | preset | iterations | precompute | query | network | total |");
    println!("|---|---|---|---|---|---|---|---|");
    for scene in scenes()? {
        for points in [8192, 50_000, usize::MAX] {
            for preset in Preset::ALL {
                let max_points = (points < scene.source.len()).then_some(points);
                let problem = Problem::pair(&scene.source, &scene.target);
                let mut runs = Vec::new();
                for seed in 0..SEEDS {
                    let options = Options {
                        seed,
                        ..preset.options(max_points)
                    };
                    backend.host().forget();
                    let clock = Clock(Instant::now());
                    let run = estimate(&backend, &problem, &options, &clock);
                    runs.push(run.map_err(|e| e.to_string())?);
                }
                let of = |value: fn(&Estimate) -> f64| median(runs.iter().map(value).collect());
                println!(
                    "| {} | {} | {} | {:.0} | {:.3} | {:.3} | {:.3} | {:.3} |",
                    scene.name,
                    runs[0].points,
                    preset.name(),
                    of(|e| e.fit().map_or(0.0, |fit| fit.iterations as f64)),
                    of(|e| e.precompute_seconds),
                    of(queries),
                    of(|e| e.method_seconds() - queries(e)),
                    of(|e| e.total_seconds)
                );
            }
        }
    }
    Ok(())
}
