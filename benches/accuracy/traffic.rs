//! Tracked objects of real drives: how many of those that move are missed, and how many of those
//! that stand get a motion. Tables of `docs/experiments/traffic.md`.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench accuracy -- traffic [--list]
//! ```
//!
//! The drives are `traffic` and `kitti_drive` (with the sweeps of `kitti_0000`) in the folder
//! `FNSF_REAL_DATA`. Ground and ego motions are estimated. The truth of an object is its tracked
//! box: [`judged`] says which boxes count. `--list` prints one line for each object and pair.

use std::collections::BTreeMap;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::{Estimate, Preset};
use nalgebra::{Isometry3, Point3, Vector3};

use super::drive::{Drive, TrackedBox, estimates, point3, read_drives};

/// An object stands below the first residual motion, is slow from the second on, and fast from the
/// third on, metres a sweep. Noise of the boxes hides whether it moves between the first two.
const STANDS_M: f64 = 0.06;
const SLOW_M: f64 = 0.1;
const FAST_M: f64 = 0.25;
/// Mean residual flow from which an object that stands has a false motion, metres.
const FALSE_M: f64 = 0.1;
/// Share of its motion that an object that moves must have; otherwise it is missed.
const FOUND: f64 = 0.5;
/// Largest second difference of the centers of a box over four sweeps, metres.
const JERK_M: f64 = 0.3;
/// Fewest points of an object.
const POINTS: usize = 10;
/// Largest share of the nearest-neighbor distance that the motion of a box may leave.
const LEFT: f64 = 0.8;
/// Bounds of the groups by range, metres.
const RANGES_M: [f64; 2] = [20.0, 40.0];

/// An object of a pair whose box counts, with the estimated flow of its points.
struct Judged<'a> {
    object: &'a TrackedBox,
    points: usize,
    /// True residual motion in the target's frame, metres.
    truth: Vector3<f64>,
    /// Mean estimated residual motion, metres.
    mean: Vector3<f64>,
    /// Mean distance of the estimated residual motions from the true one, metres.
    epe: f64,
    /// Means over the points.
    moving: f64,
    confidence: f64,
}

/// The objects of pair `index` whose boxes count.
///
/// The true motion is the slope of a line through the centers of four sweeps, the pair's and one on
/// either side, in the target's frame. A box counts if the second differences of these centers stay
/// below [`JERK_M`], it holds [`POINTS`] points or more, and, if it is fast, its motion leaves less
/// than [`LEFT`] of the mean distance from its points to the target.
fn judged<'a>(drive: &'a Drive, estimates: &[Estimate], index: usize) -> Vec<Judged<'a>> {
    let egos: Option<Vec<_>> = (index - 1..index + 2).map(|k| estimates[k].ego).collect();
    let Some(egos) = egos else {
        return Vec::new();
    };
    // From the frames of the four sweeps to the target's.
    let to_target = [
        egos[1] * egos[0],
        egos[1],
        Isometry3::identity(),
        egos[2].inverse(),
    ];
    let objects = drive.boxes[index].values().filter_map(|object| {
        let centers: Option<Vec<Vector3<f64>>> = (0..4)
            .map(|k| {
                let tracked = drive.boxes[index + k - 1].get(&object.id.to_string())?;
                Some((to_target[k] * Point3::from(tracked.center)).coords)
            })
            .collect();
        let centers = centers?;
        let jerk = |k: usize| (centers[k] - centers[k + 1] * 2.0 + centers[k + 2]).norm();
        let truth = ((centers[3] - centers[0]) * 3.0 + centers[2] - centers[1]) / 10.0;
        let judged = object_of(drive, &estimates[index], index, object, truth)?;
        (jerk(0) < JERK_M && jerk(1) < JERK_M && judged.points >= POINTS).then_some(judged)
    });
    objects.collect()
}

/// The estimated flow in the box `object`; none where its motion does not lead to the target.
fn object_of<'a>(
    drive: &Drive,
    estimate: &Estimate,
    index: usize,
    object: &'a TrackedBox,
    truth: Vector3<f64>,
) -> Option<Judged<'a>> {
    let source = &drive.sweeps[index];
    let ego = estimate.ego?;
    let rows: Vec<usize> = (0..source.len())
        .filter(|&row| object.holds(source[row]))
        .collect();
    let count = rows.len().max(1) as f64;
    let stay = |row: usize| ego * point3(source[row]);
    if truth.norm() >= FAST_M {
        let center = ego * Point3::from(object.center);
        let near: Vec<Point3<f64>> = drive.sweeps[index + 1]
            .iter()
            .map(|&point| point3(point))
            .filter(|point| (point - center).norm() < 8.0)
            .collect();
        let distance = |by: Vector3<f64>| -> f64 {
            let nearest = |position: Point3<f64>| {
                let all = near.iter().map(|point| (point - position).norm_squared());
                all.fold(1.0, f64::min).sqrt()
            };
            rows.iter().map(|&row| nearest(stay(row) + by)).sum()
        };
        if distance(truth) >= LEFT * distance(Vector3::zeros()) {
            return None;
        }
    }
    let residual =
        |&row: &usize| point3(source[row]) + point3(estimate.flow[row]).coords - stay(row);
    let objects = estimate.objects().expect("objects were searched");
    let mean_of = |values: &[f32]| {
        let of = |&row: &usize| f64::from(values[row]);
        rows.iter().map(of).sum::<f64>() / count
    };
    Some(Judged {
        object,
        points: rows.len(),
        truth,
        mean: rows.iter().map(residual).sum::<Vector3<f64>>() / count,
        epe: rows
            .iter()
            .map(|row| (residual(row) - truth).norm())
            .sum::<f64>()
            / count,
        moving: mean_of(&objects.moving),
        confidence: mean_of(&objects.confidence),
    })
}

/// Sums over the objects of a group.
#[derive(Default)]
struct Sums {
    moving: usize,
    missed: usize,
    epe: f64,
    standing: usize,
    false_motions: usize,
}

impl Sums {
    fn add(&mut self, judged: &Judged<'_>) {
        let way = judged.truth.norm();
        if way >= SLOW_M {
            self.moving += 1;
            self.epe += judged.epe;
            self.missed += usize::from(judged.mean.dot(&judged.truth) < FOUND * way * way);
        } else if way < STANDS_M {
            self.standing += 1;
            self.false_motions += usize::from(judged.mean.norm() > FALSE_M);
        }
    }

    fn print(&self, name: &str, group: &str) {
        let mean = |sum: f64, count: usize, digits: usize| match count {
            0 => "–".to_owned(),
            count => format!("{:.digits$}", sum / count as f64),
        };
        let percent = |part: usize, whole| mean(100.0 * part as f64, whole, 1);
        println!(
            "| {name} | {group} | {} | {} | {} | {} | {} |",
            self.moving,
            percent(self.missed, self.moving),
            mean(self.epe, self.moving, 3),
            self.standing,
            percent(self.false_motions, self.standing),
        );
    }
}

fn class(object: &TrackedBox) -> &'static str {
    match object.class.as_str() {
        "Car" | "Van" => "cars",
        "Truck" => "trucks",
        "Pedestrian" => "pedestrians",
        _ => "riders",
    }
}

fn range(object: &TrackedBox) -> &'static str {
    let [x, y, _] = object.center;
    match x.hypot(y) {
        range if range < RANGES_M[0] => "to 20 m",
        range if range < RANGES_M[1] => "20 to 40 m",
        _ => "beyond 40 m",
    }
}

/// The groups of the table that an object belongs to.
fn groups_of(judged: &Judged<'_>) -> Vec<&'static str> {
    if (SLOW_M..FAST_M).contains(&judged.truth.norm()) {
        vec!["slow"]
    } else {
        vec!["all others", class(judged.object), range(judged.object)]
    }
}

fn list(index: usize, judged: &Judged<'_>) {
    let [x, y, _] = judged.object.center;
    let [tx, ty, _] = judged.truth.into();
    let [mx, my, _] = judged.mean.into();
    println!(
        "pair {index}, {} {}, at {x:.1} {y:.1} m, {} points: {tx:.2} {ty:.2} m, found {mx:.2} {my:.2} m, EPE {:.3} m, moving {:.2}, confidence {:.2}",
        judged.object.class,
        judged.object.id,
        judged.points,
        judged.epe,
        judged.moving,
        judged.confidence,
    );
}

pub(super) fn run(arguments: &[String]) -> anyhow::Result<()> {
    let listed = match arguments {
        [] => false,
        [only] if only == "--list" => true,
        _ => anyhow::bail!("its one argument is --list"),
    };
    let drives = read_drives()?;
    let backend = CpuBackend::new(None)?;
    println!(
        "| drive, preset | objects | moving | missed, % | EPE, m | standing | false motion, % |"
    );
    println!("|---|---|---|---|---|---|---|");
    for drive in &drives {
        for preset in [Preset::Default, Preset::Label] {
            let (estimates, seconds) = estimates(&drive.sweeps, &backend, preset)?;
            let mut groups: BTreeMap<&str, Sums> = BTreeMap::new();
            for index in 1..estimates.len() - 1 {
                for judged in judged(drive, &estimates, index) {
                    for group in groups_of(&judged) {
                        groups.entry(group).or_default().add(&judged);
                    }
                    if listed {
                        list(index, &judged);
                    }
                }
            }
            let name = format!("{}, {}", drive.name, preset.name());
            for (group, sums) in &groups {
                sums.print(&name, group);
            }
            let pairs = estimates.len() as f64;
            println!(
                "| {name} | seconds a pair | {:.2} | | | | |",
                seconds / pairs
            );
        }
    }
    Ok(())
}
