//! Sweeps whose points are measured one after the other. Table of `docs/experiments/deskew.md`.
//!
//! ```text
//! cargo bench --bench accuracy -- deskew [--streets A..B]
//! ```
//!
//! The same streets are scanned at one instant a sweep and column by column. Ground and ego motions
//! are estimated.

use anyhow::Context;
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{SimulatedPair, Street, StreetOptions};
use fnsf::flow::{Preset, Problem, Uncontrolled, estimate};

/// Speeds of the vehicle, m/s.
const SPEEDS_MPS: [f64; 4] = [5.0, 10.0, 20.0, 30.0];
const STREETS: std::ops::Range<u64> = 5000..5010;

/// Sums over the points of several pairs.
#[derive(Default)]
struct Errors {
    /// Sums of end-point errors, metres, and counts: static points, and those of movers.
    still: [f64; 2],
    moving: [f64; 2],
    /// Pairs that were deskewed.
    deskewed: usize,
}

/// One way to scan and to estimate a street.
#[derive(Clone, Copy)]
struct Way {
    name: &'static str,
    rolling: bool,
    /// Whether the estimate gets times: true ones, or those of a spinning lidar where the sweep is
    /// taken at one instant.
    timed: bool,
}

const WAYS: [Way; 4] = [
    Way {
        name: "one instant",
        rolling: false,
        timed: false,
    },
    Way {
        name: "rolling, as it is",
        rolling: true,
        timed: false,
    },
    Way {
        name: "rolling, deskewed",
        rolling: true,
        timed: true,
    },
    Way {
        name: "one instant, with times",
        rolling: false,
        timed: true,
    },
];

pub(super) fn run(arguments: &[String]) -> anyhow::Result<()> {
    let streets = match arguments {
        [] => STREETS,
        [flag, range] if flag == "--streets" => {
            let (first, end) = range.split_once("..").context("--streets A..B")?;
            first.parse()?..end.parse()?
        }
        _ => anyhow::bail!("usage: deskew [--streets A..B]"),
    };
    let backend = CpuBackend::new(None)?;
    println!("| speed (m/s) | sweeps | static (m) | movers (m) | pairs deskewed |");
    println!("|---:|---|---:|---:|---:|");
    for speed in SPEEDS_MPS {
        for way in WAYS {
            let mut errors = Errors::default();
            for seed in streets.clone() {
                let street = Street::new(&StreetOptions {
                    seed,
                    speed_mps: Some(speed),
                    rolling: way.rolling,
                    ..StreetOptions::default()
                })?;
                add(&backend, &street.pair(0)?, way, &mut errors)?;
            }
            let mean = |[sum, count]: [f64; 2]| sum / count;
            let (still, moving) = (mean(errors.still), mean(errors.moving));
            let (name, deskewed) = (way.name, errors.deskewed);
            println!("| {speed:.0} | {name} | {still:.4} | {moving:.3} | {deskewed} |");
        }
    }
    Ok(())
}

/// The times of a spinning lidar that begins its turn behind the vehicle, seconds.
fn spinning(points: &[[f32; 3]]) -> Vec<f32> {
    use std::f32::consts::{PI, TAU};
    let time = |&[x, y, _]: &[f32; 3]| 0.1 * (y.atan2(x) + PI) / TAU;
    points.iter().map(time).collect()
}

fn add(
    backend: &CpuBackend,
    pair: &SimulatedPair,
    way: Way,
    errors: &mut Errors,
) -> anyhow::Result<()> {
    let times = pair.times.clone();
    let times = times.unwrap_or_else(|| [&pair.source, &pair.target].map(|p| spinning(p)));
    let [source, target] = &times;
    let problem = Problem {
        times: way.timed.then_some([source, target]),
        ..Problem::pair(&pair.source, &pair.target)
    };
    let found = estimate(
        backend,
        &problem,
        &Preset::Default.options(None),
        &Uncontrolled,
    )?;
    let is_deskewed = found.deskew.as_ref().is_some_and(|d| d.points.is_some());
    errors.deskewed += usize::from(is_deskewed);
    for (row, truth) in pair.flow.iter().enumerate() {
        if !found.valid[row] || pair.ground_source[row] {
            continue;
        }
        let off = |axis: usize| f64::from(found.flow[row][axis] - truth[axis]).powi(2);
        let error = (0..3).map(off).sum::<f64>().sqrt();
        let [sum, count] = match pair.dynamic[row] {
            true => &mut errors.moving,
            false => &mut errors.still,
        };
        *sum += error;
        *count += 1.0;
    }
    Ok(())
}
