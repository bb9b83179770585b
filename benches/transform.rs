//! The distance transform: build time, memory and query time.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench transform
//! ```
#![expect(clippy::print_stdout, reason = "a benchmark prints its figures")]

mod common;

use std::hint::black_box;
use std::time::Instant;

use common::{median, scenes};
use fnsf::flow::Uncontrolled;
use fnsf::flow::distance::{Bricks, DistanceOptions, Sites};

const ROUNDS: usize = 5;

/// CPU seconds of the calling thread so far; wall-clock seconds where the system does not report
/// them.
fn thread_seconds(began: Instant) -> f64 {
    let nanoseconds = std::fs::read_to_string("/proc/thread-self/schedstat")
        .ok()
        .and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
    nanoseconds.map_or(began.elapsed().as_secs_f64(), |ns| ns / 1e9)
}

fn main() -> Result<(), String> {
    let threads = |count: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build();
        pool.map_err(|e| e.to_string())
    };
    let (one, all) = (threads(1)?, threads(0)?);
    println!("medians of {ROUNDS} rounds\n");
    println!(
        "| scene | sites | dense cells | bricks | MB | build, 1 thread CPU s | build, {} threads s | query ns |",
        all.current_num_threads()
    );
    println!("|---|---|---|---|---|---|---|---|");
    for scene in scenes()? {
        for sites in [Sites::Cells, Sites::Points] {
            let options = DistanceOptions {
                sites,
                ..DistanceOptions::default()
            };
            let build = || {
                Bricks::build(&scene.source, &scene.target, &options, &Uncontrolled)
                    .map_err(|e| e.to_string())
            };
            let bricks = build()?;
            let mut cpu = Vec::new();
            let mut wall = Vec::new();
            let mut query = Vec::new();
            for _ in 0..ROUNDS {
                let began = Instant::now();
                cpu.push(one.install(|| {
                    let before = thread_seconds(began);
                    build().map(|bricks| {
                        black_box(bricks.bytes());
                        thread_seconds(began) - before
                    })
                })?);
                let began = Instant::now();
                black_box(all.install(build)?.bytes());
                wall.push(began.elapsed().as_secs_f64());
                let began = Instant::now();
                let sum: f32 = scene
                    .source
                    .iter()
                    .map(|&p| bricks.sample(p).distance)
                    .sum();
                black_box(sum);
                query.push(began.elapsed().as_secs_f64() / scene.source.len() as f64);
            }
            let cells: usize = bricks.grid().vertices.iter().product();
            println!(
                "| {} | {sites:?} | {:.2} G | {} | {:.0} | {:.3} | {:.3} | {:.0} |",
                scene.name,
                cells as f64 / 1e9,
                bricks.active_bricks(),
                bricks.bytes() as f64 / 1e6,
                median(cpu),
                median(wall),
                median(query) * 1e9
            );
        }
    }
    Ok(())
}
