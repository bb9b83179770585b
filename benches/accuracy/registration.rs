//! Accuracy of the ego motion on real and simulated pairs, and whether its covariance is honest: the
//! tables of `docs/experiments/registration.md`.
//!
//! `FNSF_REAL_DATA` names the folder of the real pairs. Without it only simulated streets are used.

use std::path::PathBuf;
use std::time::Instant;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::field::Backend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{Point, RigidTransform, Uncontrolled};
use fnsf::formats::read_pair;
use nalgebra::{Isometry3, Point3, Vector3};

use super::labelled::PAIRS;

/// Number of shifts and rotations applied to both clouds together. They move the voxel borders, so
/// that the voxel downsampling differs and the true motion does not.
const OFFSETS: usize = 8;
/// Number of seeds of each kind of street.
const SEEDS: u64 = 12;
/// Seeds of the streets that covariances are compared on. None of them was tuned on.
const FRESH: std::ops::Range<u64> = 7000..7040;

/// Two clouds and the true motion between them.
struct Case {
    source: Vec<Point>,
    target: Vec<Point>,
    truth: RigidTransform,
}

impl Case {
    fn backward(&self) -> Self {
        Self {
            source: self.target.clone(),
            target: self.source.clone(),
            truth: self.truth.inverse(),
        }
    }

    /// The case in a frame that is shifted and rotated against the sensor's.
    fn seen_from(&self, offset: usize) -> Self {
        let shift = Vector3::new(0.11, 0.07, 0.05) * offset as f64;
        let frame = Isometry3::new(shift, Vector3::new(0.0, 0.0, 0.1 * offset as f64));
        Self {
            source: moved(&self.source, &frame),
            target: moved(&self.target, &frame),
            truth: frame * self.truth * frame.inverse(),
        }
    }

    /// The case in every shifted and rotated frame.
    fn sweeps(&self) -> Vec<Self> {
        (0..OFFSETS).map(|i| self.seen_from(i)).collect()
    }

    fn without(&self, ground: [&[bool]; 2]) -> Self {
        let off = |points: &[Point], ground: &[bool]| {
            let rows = points.iter().zip(ground).filter(|(_, ground)| !**ground);
            rows.map(|(&point, _)| point).collect()
        };
        Self {
            source: off(&self.source, ground[0]),
            target: off(&self.target, ground[1]),
            truth: self.truth,
        }
    }
}

pub(super) fn run(arguments: &[String]) -> anyhow::Result<()> {
    match arguments {
        [] => accuracy(),
        [table] if table == "certainty" => certainty(),
        _ => anyhow::bail!("usage: registration [certainty]"),
    }
}

fn accuracy() -> anyhow::Result<()> {
    println!("| pairs | points | motion | off, m | worst | off, degrees | worst | ms |");
    println!("|---|---|---|---|---|---|---|---|");
    let backend = CpuBackend::new(Some(1))?;
    for (name, case) in real_cases()? {
        row(&name, &backend, &case.sweeps());
        let back = case.backward();
        row(&format!("{name}, back"), &backend, &back.sweeps());
    }
    for (beams, azimuth_steps) in [(16, 1800), (32, 1800), (64, 2000), (128, 1024)] {
        for (speed, yaw_rate) in [(0.0, 0.0), (10.0, 0.25), (30.0, 0.7)] {
            let case = |seed| {
                let sign = if seed % 2 == 0 { 1.0 } else { -1.0 };
                let pair = Street::new(&StreetOptions {
                    seed,
                    beams,
                    azimuth_steps,
                    speed_mps: Some(speed),
                    yaw_rate_rps: Some(yaw_rate * sign),
                    ..StreetOptions::default()
                })?
                .pair(0)?;
                let all = Case {
                    source: pair.source,
                    target: pair.target,
                    truth: pair.target_from_source,
                };
                let off = all.without([&pair.ground_source, &pair.ground_target]);
                anyhow::Ok([all, off])
            };
            let cases = (0..SEEDS).map(case).collect::<Result<Vec<_>, _>>()?;
            let (all, off): (Vec<_>, Vec<_>) = cases.into_iter().map(|[a, b]| (a, b)).unzip();
            let name = format!("{beams} beams, {speed} m/s");
            if speed == 30.0 {
                let turned: Vec<_> = all.iter().map(five_degrees).collect();
                row(&format!("{name}, turned to 5 degrees"), &backend, &turned);
            }
            row(&name, &backend, &all);
            row(&format!("{name}, no ground"), &backend, &off);
        }
    }
    Ok(())
}

/// The real pairs, each with and without its ground; none if `FNSF_REAL_DATA` is not set.
fn real_cases() -> anyhow::Result<Vec<(String, Case)>> {
    let mut cases = Vec::new();
    let folder = std::env::var_os("FNSF_REAL_DATA").map(PathBuf::from);
    for (folder, name) in folder.iter().flat_map(|f| PAIRS.map(|name| (f, name))) {
        let pair = read_pair(&std::fs::read(folder.join(name).join("pair.npz"))?)?;
        let ground = pair.ground.unwrap_or_default();
        let all = Case {
            source: pair.source,
            target: pair.target,
            truth: pair.ego.unwrap_or_default(),
        };
        let off = all.without([&ground.source, &ground.target]);
        cases.push((name.to_owned(), all));
        cases.push((format!("{name}, no ground"), off));
    }
    Ok(cases)
}

/// How often the six components of the true ego motion lie within two standard deviations of the
/// motion that was found.
fn certainty() -> anyhow::Result<()> {
    println!("| pairs | x, y, z | x, y, z, sigma | roll, pitch, yaw | sigma | within 2 sigma |");
    println!("|---|---|---|---|---|---|");
    let backend = CpuBackend::new(None)?;
    for (name, case) in real_cases()? {
        certainty_row(&name, &backend, &case.sweeps());
    }
    for (beams, speed_mps) in [(64, None), (64, Some(0.0)), (32, None), (16, None)] {
        for suspension in [false, true] {
            let mut streets = [Vec::new(), Vec::new()];
            for seed in FRESH {
                let options = StreetOptions {
                    seed,
                    beams,
                    speed_mps,
                    suspension,
                    ..StreetOptions::default()
                };
                let pair = Street::new(&options)?.pair(0)?;
                let all = Case {
                    source: pair.source,
                    target: pair.target,
                    truth: pair.target_from_source,
                };
                streets[1].push(all.without([&pair.ground_source, &pair.ground_target]));
                streets[0].push(all);
            }
            for (cases, ground) in streets.iter().zip(["", ", no ground"]) {
                let stands = speed_mps.map_or("", |_| ", standing");
                let body = if suspension { ", springs" } else { "" };
                let name = format!("{beams} beams{stands}{body}{ground}");
                certainty_row(&name, &backend, cases);
            }
        }
    }
    Ok(())
}

/// Prints the root mean squares of the errors and of the standard deviations, millimetres and
/// thousandths of a degree, and the share of components within two standard deviations.
fn certainty_row(name: &str, backend: &CpuBackend, cases: &[Case]) {
    let [mut errors, mut sigmas] = [[0.0; 6]; 2];
    let mut within = 0;
    let count = cases.len() as f64;
    for case in cases {
        let prior = RigidTransform::identity();
        let host = backend.host();
        let found = host.align(&case.source, &case.target, &prior, &Uncontrolled);
        let shift = found.motion.translation.vector - case.truth.translation.vector;
        let turn = (found.motion.rotation * case.truth.rotation.inverse()).scaled_axis();
        let covariance = found.covariance.unwrap_or_default();
        for (a, error) in shift.iter().chain(turn.iter()).enumerate() {
            let unit = if a < 3 { 1e3 } else { 1e3_f64.to_degrees() };
            let variance = covariance[(a, a)];
            errors[a] += (error * unit).powi(2) / count;
            sigmas[a] += variance * unit * unit / count;
            within += usize::from(error.abs() < 2.0 * variance.sqrt());
        }
    }
    let list = |squares: &[f64]| {
        let roots = squares.iter().map(|square| format!("{:.1}", square.sqrt()));
        roots.collect::<Vec<_>>().join(", ")
    };
    println!(
        "| {name} | {} | {} | {} | {} | {:.2} |",
        list(&errors[..3]),
        list(&sigmas[..3]),
        list(&errors[3..]),
        list(&sigmas[3..]),
        within as f64 / (6.0 * count)
    );
}

/// The source rotated so that the yaw between the clouds is 5 degrees.
fn five_degrees(case: &Case) -> Case {
    let own = case.truth.rotation.scaled_axis().z;
    let missing = 5_f64.to_radians() * own.signum() - own;
    let turn = Isometry3::new(Vector3::zeros(), Vector3::new(0.0, 0.0, missing));
    Case {
        source: moved(&case.source, &turn.inverse()),
        target: case.target.clone(),
        truth: case.truth * turn,
    }
}

fn moved(points: &[Point], motion: &RigidTransform) -> Vec<Point> {
    let moved = points
        .iter()
        .map(|point| motion * Point3::from(point.map(f64::from)));
    moved.map(|p| p.map(|c| c as f32).into()).collect()
}

/// Prints one row: the median and the largest error over the cases, and the shortest time. Other
/// load on the machine affects the shortest time least.
fn row(name: &str, backend: &CpuBackend, cases: &[Case]) {
    let mut meters = Vec::new();
    let mut degrees = Vec::new();
    let mut times = Vec::new();
    for case in cases {
        backend.host().clear_cache();
        let start = Instant::now();
        let prior = RigidTransform::identity();
        let found = backend
            .host()
            .align(&case.source, &case.target, &prior, &Uncontrolled)
            .motion;
        times.push(start.elapsed().as_secs_f64() * 1e3);
        let gap = case.truth.inv_mul(&found);
        meters.push(gap.translation.vector.norm());
        degrees.push(gap.rotation.angle().to_degrees());
    }
    for list in [&mut meters, &mut degrees, &mut times] {
        list.sort_by(f64::total_cmp);
    }
    let middle = |list: &[f64]| list[list.len() / 2];
    let worst = |list: &[f64]| list[list.len() - 1];
    let truth = &cases[0].truth;
    println!(
        "| {name} | {} | {:.2} m, {:.1} degrees | {:.4} | {:.4} | {:.3} | {:.3} | {:.0} |",
        cases[0].source.len(),
        truth.translation.vector.norm(),
        truth.rotation.angle().to_degrees(),
        middle(&meters),
        worst(&meters),
        middle(&degrees),
        worst(&degrees),
        times[0]
    );
}
