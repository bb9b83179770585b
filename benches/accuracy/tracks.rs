//! Tracks on real drives and on streets: tables of `docs/experiments/tracks.md`.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench accuracy -- tracks [--list]
//! ```
//!
//! The drives are those of `traffic.rs`, the streets have 30 sweeps. Objects within 60 m count.
//! `--list` prints one line for each true and each found object on stderr.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Instant;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{
    MATCHED_WITHIN_M, TrackedObject, TrackedSweep, TrackingPool, tracked_sweeps,
};
use fnsf::flow::simulate::{SWEEP_SECONDS, Street, StreetOptions, StreetSweep};
use fnsf::flow::tracks::{ClusteredSweep, Track, TrackState, Tracker, correct};
use fnsf::flow::{Estimate, OrientedBox, Point, Preset, RigidTransform};
use nalgebra::{Point3, Vector2};

use super::drive::{Drive, estimates, read_drives};

/// Streets that the tracker was tuned on, and streets that it was not.
const STREETS: [(&str, Range<u64>); 2] =
    [("tuned streets", 1000..1004), ("fresh streets", 1100..1104)];
/// Sweeps of a street.
const SWEEPS: usize = 30;
/// Farthest object that counts, metres.
const FARTHEST_M: f32 = 60.0;
/// Half of the angle that the boxes of `kitti_drive` cover, radians.
const HALF_VIEW: f32 = 0.68;
/// Sweeps on either side over which the speed of a true box is measured.
const AROUND: usize = 3;
/// Largest second difference of the centers of a box over these sweeps, metres.
const JERK_M: f64 = 0.3;

/// A sequence with its tracks.
struct Tracked {
    plain: Vec<Estimate>,
    /// The estimates with the motions of the tracks where they were missed.
    corrected: Vec<Estimate>,
    tracks: Vec<Track>,
    /// Seconds of the tracks and the corrections.
    seconds: f64,
}

/// The tracks of `sweeps` with these estimates, whose missed motions are corrected.
fn tracked(sweeps: &[Vec<Point>], estimates: &mut [Estimate]) -> anyhow::Result<Vec<Track>> {
    const DT_S: f32 = SWEEP_SECONDS as f32;
    let mut tracker = Tracker::default();
    for (sweeps, estimate) in sweeps.windows(2).zip(estimates) {
        let known = tracker.push(&ClusteredSweep::new(&sweeps[0], estimate, DT_S)?)?;
        correct(estimate, [&sweeps[0], &sweeps[1]], &known, DT_S);
    }
    Ok(tracker.finish())
}

/// Sums of end-point errors off the ground, metres, and numbers of points.
#[derive(Default)]
struct Errors {
    moving: [f64; 2],
    still: [f64; 2],
}

impl Errors {
    /// Adds the flows of a street's estimates.
    fn add(
        &mut self,
        street: &Street,
        sweeps: &[StreetSweep],
        estimates: &[Estimate],
    ) -> anyhow::Result<()> {
        for (sweep, estimate) in sweeps.iter().zip(estimates) {
            let pair = street.pair(sweep.index)?;
            for row in 0..sweep.points.len() {
                if sweep.ground[row] || !estimate.valid[row] {
                    continue;
                }
                let off = |a: usize| f64::from(estimate.flow[row][a] - pair.flow[row][a]);
                let sums = if pair.dynamic[row] {
                    &mut self.moving
                } else {
                    &mut self.still
                };
                sums[0] += off(0).hypot(off(1)).hypot(off(2));
                sums[1] += 1.0;
            }
        }
        Ok(())
    }

    /// Means of the moving and of the static points, metres.
    fn means(&self) -> [f64; 2] {
        [self.moving, self.still].map(|[sum, count]| sum / count.max(1.0))
    }
}

/// The true tracks of a drive, from its boxes and the ego motions of `estimates`. Boxes whose
/// centers jump have no points, so that they are ignored.
fn true_tracks(drive: &Drive, estimates: &[Estimate]) -> Vec<Track> {
    let mut world = vec![RigidTransform::identity()];
    for estimate in estimates {
        let ego = estimate.ego.unwrap_or_else(RigidTransform::identity);
        world.push(world[world.len() - 1] * ego.inverse());
    }
    let mut tracks: BTreeMap<&str, Track> = BTreeMap::new();
    for (index, boxes) in drive.boxes.iter().enumerate() {
        for (name, object) in boxes {
            let at = |k: usize| {
                let object = drive.boxes.get(k)?.get(name)?;
                let center = world[k] * Point3::from(object.center);
                Some((k as f64, center.coords.xy()))
            };
            let around: Vec<_> = (index.saturating_sub(AROUND)..=index + AROUND)
                .filter_map(at)
                .collect();
            let is_smooth = around
                .windows(3)
                .all(|c| (c[0].1 - c[1].1 * 2.0 + c[2].1).norm() < JERK_M);
            let points = drive.sweeps[index].iter();
            let points = points.filter(|&&point| object.holds(point)).count();
            let next = tracks.len() as u32 + 1;
            let track = tracks.entry(name).or_insert_with(|| Track {
                id: next,
                states: Vec::new(),
            });
            // The metrics use the length of the velocity alone.
            let velocity = slope(&around) / SWEEP_SECONDS;
            track.states.push(TrackState {
                sweep: index as u32,
                bounds: OrientedBox {
                    center: object.center.map(|c| c as f32),
                    size: object.size.map(|c| c as f32),
                    yaw: object.yaw as f32,
                },
                velocity: [velocity.x as f32, velocity.y as f32, 0.0],
                points: if is_smooth { points as u32 } else { 0 },
                ..TrackState::default()
            });
        }
    }
    tracks.into_values().collect()
}

/// The slope of the line through positions at times.
fn slope(positions: &[(f64, Vector2<f64>)]) -> Vector2<f64> {
    let count = positions.len().max(1) as f64;
    let mean_at = positions.iter().map(|(at, _)| at).sum::<f64>() / count;
    let squares: f64 = positions.iter().map(|(at, _)| (at - mean_at).powi(2)).sum();
    let products = positions.iter().map(|(at, p)| p * (at - mean_at));
    products.sum::<Vector2<f64>>() / squares.max(f64::MIN_POSITIVE)
}

/// The sweeps with the objects at positions that count.
fn in_view(mut sweeps: Vec<TrackedSweep>, counts: impl Fn([f32; 2]) -> bool) -> Vec<TrackedSweep> {
    for TrackedSweep {
        truth,
        ignored,
        found,
    } in &mut sweeps
    {
        ignored.extend(truth.iter().filter(|object| !counts(object.position)));
        truth.retain(|object| counts(object.position));
        found.retain(|object| counts(object.position));
    }
    sweeps
}

fn is_near([x, y]: [f32; 2]) -> bool {
    x.hypot(y) < FARTHEST_M
}

fn print(name: &str, pool: &TrackingPool, seconds: f64) {
    let m = pool.metrics();
    let percent = |part: usize, whole: usize| 100.0 * part as f64 / whole.max(1) as f64;
    println!(
        "| {name} | {} | {:.1} | {:.1} | {} | {:.2} | {:.3} | {:.3} | {:.3} | {:.1} |",
        m.truth,
        percent(m.matches, m.truth),
        percent(m.matches, m.found),
        m.switches,
        m.distance_m,
        m.mota,
        m.idf1,
        m.hota,
        1000.0 * seconds,
    );
}

/// Prints in how many sweeps each object is there, in how many of these the other is within reach,
/// and where it is first.
fn list(name: &str, sweeps: &[TrackedSweep]) {
    let near = |a: &TrackedObject, b: &TrackedObject| {
        let [x, y] = [0, 1].map(|axis| a.position[axis] - b.position[axis]);
        f64::from(x.hypot(y)) < MATCHED_WITHIN_M
    };
    /// First sweep, number of sweeps, sweeps with the other, first position.
    type Seen = (usize, usize, usize, [f32; 2]);
    let mut objects: BTreeMap<(&str, u32), Seen> = BTreeMap::new();
    for (index, sweep) in sweeps.iter().enumerate() {
        let mut see = |kind, of: &[TrackedObject], others: &[&[TrackedObject]]| {
            for object in of {
                let first = (index, 0, 0, object.position);
                let seen = objects.entry((kind, object.id)).or_insert(first);
                seen.1 += 1;
                let mut others = others.iter().copied().flatten();
                seen.2 += usize::from(others.any(|other| near(object, other)));
            }
        };
        see("true", &sweep.truth, &[&sweep.found]);
        see("found", &sweep.found, &[&sweep.truth, &sweep.ignored]);
    }
    for ((kind, id), (first, count, both, [x, y])) in objects {
        eprintln!(
            "{name}, {kind} {id}: from sweep {first} at {x:.1} {y:.1} m, {count} sweeps, {both} with the other"
        );
    }
}

pub(super) fn run(arguments: &[String]) -> anyhow::Result<()> {
    let listed = match arguments {
        [] => false,
        [only] if only == "--list" => true,
        _ => anyhow::bail!("its one argument is --list"),
    };
    let backend = CpuBackend::new(None)?;
    let drives = read_drives()?;
    println!(
        "| drive, preset | objects x sweeps | recall, % | precision, % | switches | distance, m | MOTA | IDF1 | HOTA | ms a sweep |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
    let mut flows = Vec::new();
    for preset in [Preset::Default, Preset::Label] {
        let track = |sweeps: &[Vec<Point>]| -> anyhow::Result<Tracked> {
            let (plain, _) = estimates(sweeps, &backend, preset)?;
            let mut corrected = plain.clone();
            let began = Instant::now();
            let tracks = tracked(sweeps, &mut corrected)?;
            Ok(Tracked {
                plain,
                corrected,
                tracks,
                seconds: began.elapsed().as_secs_f64(),
            })
        };
        for drive in &drives {
            let found = track(&drive.sweeps)?;
            let truth = true_tracks(drive, &found.plain);
            let sweeps = tracked_sweeps(&truth, &found.tracks);
            let sweeps = in_view(sweeps, |position| {
                is_near(position)
                    && (drive.name != "kitti_drive"
                        || position[1].atan2(position[0]).abs() < HALF_VIEW)
            });
            if listed {
                list(drive.name, &sweeps);
            }
            let mut pool = TrackingPool::default();
            pool.add(&sweeps);
            let name = format!("{}, {}", drive.name, preset.name());
            print(&name, &pool, found.seconds / drive.sweeps.len() as f64);
        }
        for (name, seeds) in STREETS {
            let mut pool = TrackingPool::default();
            let mut errors: [Errors; 2] = Default::default();
            let (mut total, mut count) = (0.0, 0.0);
            for seed in seeds {
                let street = Street::new(&StreetOptions {
                    seed,
                    sweeps: SWEEPS,
                    ..StreetOptions::default()
                })?;
                let sweeps = (0..SWEEPS).map(|index| street.sweep(index));
                let sweeps = sweeps.collect::<Result<Vec<_>, _>>()?;
                let truth = street.tracks(&sweeps);
                let points: Vec<_> = sweeps.iter().map(|sweep| sweep.points.clone()).collect();
                let found = track(&points)?;
                (total, count) = (total + found.seconds, count + SWEEPS as f64);
                errors[0].add(&street, &sweeps, &found.plain)?;
                errors[1].add(&street, &sweeps, &found.corrected)?;
                let sweeps = in_view(tracked_sweeps(&truth, &found.tracks), is_near);
                if listed {
                    list(&format!("street {seed}"), &sweeps);
                }
                pool.add(&sweeps);
            }
            let name = format!("{name}, {}", preset.name());
            print(&name, &pool, total / count);
            let [before, after] = errors.each_ref().map(Errors::means);
            flows.push(format!(
                "| {name} | {:.4} | {:.4} | {:.5} | {:.5} |",
                before[0], after[0], before[1], after[1]
            ));
        }
    }
    println!(
        "\n| streets, preset | EPE moving, m | with tracks | EPE static, m | with tracks |\n|---|---|---|---|---|\n{}",
        flows.join("\n")
    );
    Ok(())
}
