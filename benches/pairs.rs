//! Whole pairs: the phases of `default`, the machine's ceilings, and every preset at several sizes.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench pairs
//! ```
#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]

mod common;

use std::time::Instant;

use common::{Scene, median, scenes, street};
use fnsf::flow::cpu::{CpuBackend, Isa, multiply_add_peak};
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
    let scenes = scenes()?;
    objects_by_phase(&scenes)?;
    ceilings();
    presets_by_size(&scenes)
}

/// What one thread of the machine can do at most: the phases are compared with it.
fn ceilings() {
    const ROUNDS: usize = 5;
    /// Repetitions of a few vector multiply-adds.
    const REPETITIONS: usize = 2_000_000;
    /// Lines of 64 bytes that no cache holds.
    const BUFFER: usize = 4 << 20;
    /// Lines of about the size of an index of points.
    const TABLE: usize = 64 << 10;
    /// Lines that are read in random order.
    const GATHERED: usize = 4 << 20;
    let best = |work: &mut dyn FnMut() -> f64| {
        let rate = || {
            let began = Instant::now();
            work() / began.elapsed().as_secs_f64()
        };
        std::iter::repeat_with(rate)
            .take(ROUNDS)
            .fold(0.0, f64::max)
    };
    let lines = vec![[1.0_f32; 16]; BUFFER];
    let peak = best(&mut || multiply_add_peak(Isa::available()[0], REPETITIONS));
    let streamed = best(&mut || {
        let sums = lines.iter().fold([0.0_f32; 16], |sums, line| {
            core::array::from_fn(|lane| sums[lane] + line[lane])
        });
        std::hint::black_box(sums);
        size_of_val(lines.as_slice()) as f64
    });
    let gathered = best(&mut || {
        let (mut at, mut sum) = (1_usize, 0.0);
        for _ in 0..GATHERED {
            // A linear congruential generator: the next address does not wait for the load.
            at = at.wrapping_mul(0x5851_F42D_4C95_7F2D).wrapping_add(1);
            sum += lines[(at >> 40) % TABLE][0];
        }
        std::hint::black_box(sum);
        GATHERED as f64
    });
    println!("Ceilings of one thread, best of {ROUNDS}\n");
    println!(
        "| multiply-adds, GFLOP/s | reads from memory, GB/s | random lines of 4 MB, ns each |"
    );
    println!("|---|---|---|");
    println!(
        "| {:.0} | {:.1} | {:.1} |\n",
        peak / 1e9,
        streamed / 1e9,
        1e9 / gathered
    );
}

/// Numbers of beams and azimuth steps of the streets beside the pairs. The last has a million
/// points.
const STREETS: [[usize; 2]; 4] = [[32, 2000], [64, 2000], [128, 2000], [128, 8192]];
/// Rounds of the table by phase. All scenes take turns in each.
const ROUNDS: usize = 7;

/// The phases of `default`, by scene and number of threads.
fn objects_by_phase(pairs: &[Scene]) -> Result<(), String> {
    let mut scenes: Vec<Scene> = Vec::new();
    for [beams, azimuth_steps] in STREETS {
        scenes.push(street(beams, azimuth_steps)?);
    }
    // The first of the pairs is a street.
    let scenes: Vec<&Scene> = pairs[1..].iter().chain(&scenes).collect();
    let options = Preset::Default.options(None);
    println!("`default`, whole sweeps, nothing given; medians of {ROUNDS} rounds in turn, ms\n");
    println!(
        "| scene | points | threads | ground | ego motion | clouds | clusters | assignment | rest | all |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    let backends = [1, 2].map(|threads| CpuBackend::new(Some(threads)));
    let [one, two] = backends.map(|backend| backend.map_err(|e| e.to_string()));
    let backends = [one?, two?];
    let mut runs = vec![[const { Vec::new() }; 2]; scenes.len()];
    for _ in 0..ROUNDS {
        for (scene, runs) in scenes.iter().zip(&mut runs) {
            let problem = Problem::pair(&scene.source, &scene.target);
            for (backend, runs) in backends.iter().zip(runs) {
                backend.host().clear_cache();
                let clock = Clock(Instant::now());
                let estimate = estimate(backend, &problem, &options, &clock);
                runs.push(phases(&estimate.map_err(|e| e.to_string())?));
            }
        }
    }
    for (scene, runs) in scenes.iter().zip(&runs) {
        for (threads, runs) in (1..).zip(runs) {
            let of = |phase: usize| median(runs.iter().map(|run: &[f64; 7]| run[phase]).collect());
            let ms: Vec<String> = (0..7).map(|phase| format!("{:.1}", of(phase))).collect();
            let (name, points) = (&scene.name, scene.source.len());
            println!("| {name} | {points} | {threads} | {} |", ms.join(" | "));
        }
    }
    println!();
    Ok(())
}

/// Milliseconds of the phases of an object search, and of all of them.
fn phases(estimate: &Estimate) -> [f64; 7] {
    let search = estimate.object_search().expect("an object search").seconds;
    let found = search.preparation + search.clusters + search.assignment;
    [
        estimate.selection_seconds,
        estimate.precompute_seconds - estimate.selection_seconds,
        search.preparation,
        search.clusters,
        search.assignment,
        estimate.method_seconds() - found,
        estimate.total_seconds,
    ]
    .map(|seconds| seconds * 1e3)
}

/// Every preset by the number of points.
fn presets_by_size(scenes: &[Scene]) -> Result<(), String> {
    let backend = CpuBackend::new(None).map_err(|e| e.to_string())?;
    println!("{}; medians of {SEEDS} seeds, seconds\n", backend.name());
    println!("| scene | points | preset | iterations | precompute | query | network | total |");
    println!("|---|---|---|---|---|---|---|---|");
    for scene in scenes {
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
                    backend.host().clear_cache();
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
