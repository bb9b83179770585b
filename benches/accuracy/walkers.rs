//! How many of the moving objects of streets of five sweeps are found, by type and distance: the
//! table of `docs/experiments/neighbors.md`.
//!
//! `walkers [FROM TO]`: the seeds of the streets.

use std::collections::BTreeMap;

use anyhow::Context;
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{Kind, Street, StreetOptions};
use fnsf::flow::{
    Ground, NeighborSweep, Options, Point, Preset, Problem, RigidTransform, Uncontrolled, estimate,
};
use nalgebra::Vector3;

use super::drive::point3;

/// Sweeps of a street, and the source of the pair among them.
const SWEEPS: usize = 5;
const SOURCE: usize = 2;
/// Movers of a street.
const MOVERS: usize = 32;
/// Least points and motion of an object that counts, metres a sweep.
const LEAST_POINTS: f64 = 10.0;
const LEAST_M: f64 = 0.05;
/// Bound between near and far objects, metres.
const NEAR_M: f64 = 30.0;
/// Motions of pedestrians of 1 to 2 m/s, metres a sweep.
const WALKING_M: [f64; 2] = [0.1, 0.2];

/// Sums over the points of one object.
#[derive(Default)]
struct Sums {
    points: f64,
    motion: Vector3<f64>,
    error_m: f64,
    range_m: f64,
}

pub(super) fn run(arguments: &[String]) -> anyhow::Result<()> {
    let seeds: Vec<u64> = arguments
        .iter()
        .map(|text| text.parse().context("a seed"))
        .collect::<anyhow::Result<_>>()?;
    let seeds = match seeds[..] {
        [] => 9000..9025,
        [from, to] => from..to,
        _ => anyhow::bail!("usage: walkers [FROM TO]"),
    };
    println!("| objects | preset | number | found | off by a third at most | error over motion |");
    println!("|---|---|---|---|---|---|");
    let backend = CpuBackend::new(None)?;
    for preset in [Preset::Default, Preset::Label] {
        let mut groups: BTreeMap<String, Vec<[f64; 2]>> = BTreeMap::new();
        let mut still = [0.0; 3];
        for seed in seeds.clone() {
            let street = Street::new(&StreetOptions {
                seed,
                sweeps: SWEEPS,
                movers: MOVERS,
                ..StreetOptions::default()
            })?;
            judge(&backend, &street, preset, &mut groups, &mut still)?;
        }
        for (name, objects) in &groups {
            let count = objects.len() as f64;
            let share = |most: f64| {
                let found = objects.iter().filter(|[off, way]| *off < most * way);
                found.count() as f64 / count
            };
            let [off, way] = [0, 1].map(|i| objects.iter().map(|both| both[i]).sum::<f64>());
            println!(
                "| {name} | {} | {count} | {:.2} | {:.2} | {:.3} |",
                preset.name(),
                share(0.5),
                share(1.0 / 3.0),
                off / way
            );
        }
        let [points, off_m, false_motion] = still;
        println!(
            "| static points: mean {:.5} m, {:.3}% off by 0.05 m | {} | | | | |",
            off_m / points,
            100.0 * false_motion / points,
            preset.name()
        );
    }
    Ok(())
}

/// Estimates the pair in the middle of a street. Adds the error and the motion of each moving object
/// to its groups, and the points, errors and false motions of static points to `still`.
fn judge(
    backend: &CpuBackend,
    street: &Street,
    preset: Preset,
    groups: &mut BTreeMap<String, Vec<[f64; 2]>>,
    still: &mut [f64; 3],
) -> anyhow::Result<()> {
    let sweeps = (0..SWEEPS).map(|index| street.sweep(index));
    let sweeps = sweeps.collect::<Result<Vec<_>, _>>()?;
    let pair = street.pair(SOURCE)?;
    let neighbors: Vec<NeighborSweep<'_>> = sweeps
        .iter()
        .filter(|sweep| !(SOURCE..SOURCE + 2).contains(&sweep.index))
        .map(|sweep| NeighborSweep {
            points: &sweep.points,
            ground: Some(&sweep.ground),
            times: None,
            at: sweep.index as i8 - SOURCE as i8,
        })
        .collect();
    let problem = Problem {
        ground: Some([&pair.ground_source, &pair.ground_target]),
        neighbors: &neighbors,
        ..Problem::pair(&pair.source, &pair.target)
    };
    let options = Options {
        ground: Ground::Mask,
        ..preset.options(None)
    };
    let found = estimate(backend, &problem, &options, &Uncontrolled)?;
    let mut objects: BTreeMap<i32, Sums> = BTreeMap::new();
    for row in (0..pair.source.len()).filter(|&row| !pair.ground_source[row]) {
        let rest = residual(&pair.target_from_source, pair.source[row], pair.flow[row]);
        let flow = residual(&pair.target_from_source, pair.source[row], found.flow[row]);
        let off_m = (flow - rest).norm();
        if !pair.dynamic[row] {
            still[0] += 1.0;
            still[1] += flow.norm();
            still[2] += f64::from(u8::from(flow.norm() > LEAST_M));
        } else if pair.object[row] >= 0 {
            let [x, y, _] = pair.source[row].map(f64::from);
            let sums = objects.entry(pair.object[row]).or_default();
            sums.points += 1.0;
            sums.motion += rest;
            sums.error_m += off_m;
            sums.range_m += x.hypot(y);
        }
    }
    for (object, sums) in objects {
        let way_m = (sums.motion / sums.points).norm();
        let kind = street.kind(object).context("a mover has a type")?;
        if sums.points < LEAST_POINTS || way_m < LEAST_M {
            continue;
        }
        let is_near = sums.range_m < NEAR_M * sums.points;
        let judged = [sums.error_m / sums.points, way_m];
        let place = if is_near { "within" } else { "beyond" };
        let name = format!("{kind:?}s {place} {NEAR_M} m").to_lowercase();
        groups.entry(name).or_default().push(judged);
        if kind == Kind::Pedestrian && is_near && (WALKING_M[0]..WALKING_M[1]).contains(&way_m) {
            let name = format!("pedestrians of 1 to 2 m/s within {NEAR_M} m");
            groups.entry(name).or_default().push(judged);
        }
    }
    Ok(())
}

/// A flow without the ego motion, metres.
fn residual(ego: &RigidTransform, point: Point, flow: Point) -> Vector3<f64> {
    let point = point3(point);
    Vector3::from(flow.map(f64::from)) - (ego * point - point)
}
