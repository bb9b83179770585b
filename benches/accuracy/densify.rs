//! Accuracy of densification: the tables of `docs/experiments/densify.md`.
//!
//! ```text
//! [FNSF_PRESET=label] cargo bench --bench accuracy -- densify [SWEEP...]
//! ```
//!
//! On simulated streets: the error of the moved points by age, compared with that of the ego motion
//! alone. On the given sweeps: the distance of the points of other sweeps to the surfaces of the
//! middle sweep.

use std::collections::BTreeMap;
use std::time::Instant;

use super::camera::{camera, depth_row};
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::densify::{FlowEdge, LaterSweeps, Plan, densify};
use fnsf::flow::depth::{Occlusion, project};
use fnsf::flow::distance::{DistanceOptions, DistanceTransform, Sites};
use fnsf::flow::ground::{GroundOptions, segment};
use fnsf::flow::simulate::{Street, StreetOptions, StreetSweep};
use fnsf::flow::{DenseCloud, MotionField, Point, Preset, Residual, Sequence, Sweep, Uncontrolled};
use fnsf::formats::read_cloud;

/// Number of sweeps of a simulated drive, and the index of the reference sweep.
const FRAMES: usize = 11;
const INTO: usize = 5;

/// Number of simulated drives.
const STREETS: u64 = 4;

type Fields = BTreeMap<FlowEdge, MotionField>;

/// The preset named by `FNSF_PRESET`; `label` by default.
fn preset() -> anyhow::Result<Preset> {
    let name = std::env::var("FNSF_PRESET").unwrap_or_else(|_| "label".to_owned());
    let found = Preset::ALL.into_iter().find(|preset| preset.name() == name);
    found.ok_or_else(|| anyhow::anyhow!("no preset {name}"))
}

/// Estimates the motion fields of all edges of the plans, each chain in its order.
fn fit(backend: &CpuBackend, sweeps: &[Sweep], plans: &[Plan]) -> anyhow::Result<Fields> {
    let options = preset()?.options(None);
    let mut fields = Fields::new();
    for chain in plans.iter().flat_map(Plan::chains) {
        let mut sequence = Sequence::default();
        let (mut edges, mut found) = (Vec::new(), Vec::new());
        for (number, edge) in chain.into_iter().enumerate() {
            let mut push = |index: usize| {
                sequence.push(backend, sweeps[index].clone(), &options, &Uncontrolled)
            };
            if number == 0 {
                push(edge.source)?;
            }
            found.extend(push(edge.target)?);
            edges.push(edge);
        }
        found.extend(sequence.finish(backend, &Uncontrolled)?);
        let found = found.into_iter().map(|estimate| estimate.motion);
        fields.extend(edges.into_iter().zip(found));
    }
    Ok(fields)
}

fn carried(
    backend: &CpuBackend,
    sweeps: &[Sweep],
    fields: &Fields,
    plan: &Plan,
) -> anyhow::Result<DenseCloud> {
    Ok(densify(
        backend,
        plan,
        sweeps,
        |edge| fields.get(&edge),
        &Uncontrolled,
    )?)
}

/// The same motion fields without their residual motion.
fn still(fields: &Fields) -> Fields {
    let still = |field: &MotionField| MotionField {
        ego: field.ego,
        residual: Residual::Still,
    };
    let fields = fields.iter();
    fields.map(|(edge, field)| (*edge, still(field))).collect()
}

fn ground_found(points: Vec<Point>) -> Sweep {
    let ground = Some(segment(&points, &GroundOptions::default()).ground);
    Sweep {
        points,
        ground,
        ..Sweep::default()
    }
}

fn distance(a: Point, b: Point) -> f64 {
    (0..3)
        .map(|i| f64::from(a[i] - b[i]).powi(2))
        .sum::<f64>()
        .sqrt()
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

/// Adds one row per age: mean error of the moving points and of the static points, metres. Each for
/// the ego motion alone, the reverse fields and the inverse fields.
fn simulated(
    backend: &CpuBackend,
    seed: u64,
    rows: &mut Vec<[f64; 7]>,
    depths: &mut [[f64; 4]; 3],
) -> anyhow::Result<()> {
    let street = Street::new(&StreetOptions {
        seed,
        sweeps: FRAMES,
        ..StreetOptions::default()
    })?;
    let scanned = (0..FRAMES).map(|k| street.sweep(k));
    let scanned: Vec<StreetSweep> = scanned.collect::<Result<_, _>>()?;
    let sweeps: Vec<Sweep> = scanned
        .iter()
        .map(|sweep| ground_found(sweep.points.clone()))
        .collect();
    let reverse = Plan::new(FRAMES, INTO as f64, LaterSweeps::Reverse, 1)?;
    let inverse = Plan::new(FRAMES, INTO as f64, LaterSweeps::Inverse, 1)?;
    let fields = fit(backend, &sweeps, &[reverse, inverse])?;
    let clouds = [
        carried(backend, &sweeps, &still(&fields), &reverse)?,
        carried(backend, &sweeps, &fields, &reverse)?,
        carried(backend, &sweeps, &fields, &inverse)?,
    ];
    let mut first = 0;
    for frame in &scanned {
        let count = frame.points.len();
        let age = INTO as f64 - frame.index as f64;
        let to_into = street.flow_to(frame, INTO as f64);
        let next = street.flow(frame.index)?;
        let next_pose = street.pose((frame.index + 1) as f64);
        let step = next_pose.inv_mul(&frame.world_from_sensor);
        let moves = |row: usize| {
            let point = frame.points[row];
            let moved = step * nalgebra::Point3::from(point.map(f64::from));
            let there: Point = core::array::from_fn(|a| point[a] + next[row][a]);
            distance([moved.x as f32, moved.y as f32, moved.z as f32], there) > 0.05
        };
        let moves: Vec<bool> = (0..count).map(moves).collect();
        let mut row = [age, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        for (k, cloud) in clouds.iter().enumerate() {
            let indices: Vec<usize> = match first_of(cloud, frame.index) {
                Some(at) => (at..at + count).collect(),
                None => continue,
            };
            let error = |row: usize| {
                let point = frame.points[row];
                let truth = core::array::from_fn(|a| point[a] + to_into[row][a]);
                distance(cloud.points[indices[row]], truth)
            };
            row[1 + k] = mean((0..count).filter(|&r| moves[r]).map(error));
            row[4 + k] = mean(
                (0..count)
                    .filter(|&r| !moves[r] && !frame.ground[r])
                    .map(error),
            );
        }
        rows.push(row);
        first += count;
    }
    anyhow::ensure!(first == clouds[0].points.len(), "no point is lost");
    let camera = camera()?;
    let truth = street.depth(INTO, &camera)?;
    let own = project(&sweeps[INTO].points, &camera);
    let seen = [&clouds[0], &clouds[1]].map(|cloud| project(&cloud.points, &camera));
    for (sum, image) in depths.iter_mut().zip([&own, &seen[0], &seen[1]]) {
        let image = image.without_occluded(&Occlusion::of(&camera));
        let row = depth_row(&image, &truth)?;
        for (sum, value) in sum.iter_mut().zip(row) {
            *sum += value / STREETS as f64;
        }
    }
    Ok(())
}

/// The first row of a sweep's points in a dense cloud.
fn first_of(cloud: &DenseCloud, frame: usize) -> Option<usize> {
    cloud.sweep.iter().position(|&f| f as usize == frame)
}

/// Prints the distance of the points of each age to the surfaces of the middle sweep.
fn real(backend: &CpuBackend, paths: &[String]) -> anyhow::Result<()> {
    let read = |path: &String| anyhow::Ok(read_cloud(&std::fs::read(path)?, Some(path))?.points);
    let sweeps = paths.iter().map(|path| read(path).map(ground_found));
    let sweeps: Vec<Sweep> = sweeps.collect::<Result<_, _>>()?;
    let into = sweeps.len() / 2;
    let plan = Plan::new(sweeps.len(), into as f64, LaterSweeps::Reverse, 1)?;
    let began = Instant::now();
    let fields = fit(backend, &sweeps, &[plan])?;
    let fitted = began.elapsed().as_secs_f64();
    let cloud = carried(backend, &sweeps, &fields, &plan)?;
    let gathered = began.elapsed().as_secs_f64() - fitted;
    println!(
        "{} points of {} sweeps in sweep {into}: {fitted:.1} s for {} fits, {gathered:.1} s to carry them\n",
        cloud.points.len(),
        sweeps.len(),
        fields.len()
    );
    let options = DistanceOptions {
        sites: Sites::Points,
        ..DistanceOptions::default()
    };
    let target = &sweeps[into].points;
    let transform = DistanceTransform::build(&cloud.points, target, &options, &Uncontrolled)?;
    let off = |points: &[Point]| -> Vec<f32> {
        let sampled = points.iter().map(|&point| transform.sample(point).distance);
        sampled.collect()
    };
    let ego_alone = carried(backend, &sweeps, &still(&fields), &plan)?;
    let distances = off(&cloud.points);
    let alone = off(&ego_alone.points);
    println!(
        "| age | static: median, m | mean to 0.5 m | mean | moving: mean, m | by ego motion alone, m |"
    );
    println!("|---|---|---|---|---|---|");
    let rows = |moving: bool, of: &dyn Fn(usize) -> bool| -> Vec<usize> {
        (0..cloud.points.len())
            .filter(|&row| cloud.dynamic[row] == moving && of(cloud.sweep[row] as usize))
            .collect()
    };
    let print = |name: String, of: &dyn Fn(usize) -> bool| {
        let mut still: Vec<f32> = rows(false, of).iter().map(|&row| distances[row]).collect();
        still.sort_by(f32::total_cmp);
        let all = |most: f32| mean(still.iter().map(|&d| f64::from(d.min(most))));
        let movers = rows(true, of);
        let moving = |from: &[f32]| mean(movers.iter().map(|&row| f64::from(from[row])));
        println!(
            "| {name} | {:.4} | {:.4} | {:.4} | {:.4} | {:.4} |",
            still[still.len() / 2],
            all(0.5),
            all(f32::INFINITY),
            moving(&distances),
            moving(&alone),
        );
    };
    for index in 0..sweeps.len() {
        print(format!("{:+}", into as i64 - index as i64), &|frame| {
            frame == index
        });
    }
    print("both neighbors".to_owned(), &|frame| {
        frame.abs_diff(into) == 1
    });
    print("all but its own".to_owned(), &|frame| frame != into);
    Ok(())
}

pub(super) fn run(arguments: Vec<String>) -> anyhow::Result<()> {
    let backend = CpuBackend::new(None)?;
    let paths: Vec<String> = arguments.into_iter().collect();
    if !paths.is_empty() {
        real(&backend, &paths)?;
    }
    let (mut rows, mut depths) = (Vec::new(), [[0.0; 4]; 3]);
    for seed in 0..STREETS {
        simulated(&backend, seed, &mut rows, &mut depths)?;
    }
    println!("| depth of | pixels | mean error, m | RMSE, m | within 5 % |");
    println!("|---|---|---|---|---|");
    let names = [
        "its own sweep",
        "all, by ego motion alone",
        "all, by the fields",
    ];
    for (name, [density, mean, rmse, within]) in names.into_iter().zip(depths) {
        let [density, within] = [density, within].map(|share| 100.0 * share);
        println!("| {name} | {density:.1} % | {mean:.2} | {rmse:.2} | {within:.1} % |");
    }
    println!(
        "| age | movers: ego motion alone, m | reverse fields, m | inverse fields, m | static: ego motion alone, m | reverse, m | inverse, m |"
    );
    println!("|---|---|---|---|---|---|---|");
    for index in 0..FRAMES {
        let of_age: Vec<&[f64; 7]> = rows.iter().skip(index).step_by(FRAMES).collect();
        let column = |k: usize| mean(of_age.iter().map(|row| row[k]));
        println!(
            "| {:+} | {:.3} | {:.3} | {:.3} | {:.4} | {:.4} | {:.4} |",
            of_age[0][0],
            column(1),
            column(2),
            column(3),
            column(4),
            column(5),
            column(6)
        );
    }
    Ok(())
}
