//! Flow of objects whose motion a pair missed.
//!
//! An object that moves before and after does not stand for a tenth of a second in between. Where
//! the estimate of a pair says so, the rows of its cluster get the motion of the track, if it leads
//! them nearer to the target than the flow of the pair.

use super::carried::Carried;
use super::tracker::{ClusteredSweep, TrackError, TrackedCluster, Tracker};
use crate::flow::data::{DYNAMIC_M, Point, transform_points};
use crate::flow::estimate::{Estimate, Solution};
use crate::flow::spatial::ColumnIndex;

/// Distances from the target are truncated here, metres.
const TRUNCATION_M: f32 = 0.3;
/// Distance over which the distances of neighboring rows are averaged, metres.
const AROUND_M: f32 = 0.3;
/// A row keeps its flow if the motion leads it farther from the target by more than this, metres.
const FARTHER_M: f32 = 0.05;

/// Pushes the source of a pair to the tracker, and corrects the estimate of the pair by [`correct`],
/// whose arguments and result these are.
///
/// # Errors
/// [`TrackError`]; the tracker and the estimate are then unchanged.
pub fn push_and_correct(
    tracker: &mut Tracker,
    [source, target]: [&[Point]; 2],
    estimate: &mut Estimate,
    dt_s: f32,
) -> Result<usize, TrackError> {
    let sweep = ClusteredSweep::new(source, estimate, dt_s)?;
    let tracked = tracker.push(&sweep)?;
    Ok(correct(estimate, [source, target], &tracked, dt_s))
}

/// Gives the rows of missed clusters the motion of their objects, and returns the number of these
/// rows.
///
/// `estimate` is that of the pair of `source` and `target`, points in the frames of their sweeps,
/// metres. `tracked` is what the tracker returned for the source. `dt_s` is the time between the
/// sweeps, seconds. Flow, dynamic flags and the velocity of the cluster change, and
/// [`Estimate::motion`] does not.
pub fn correct(
    estimate: &mut Estimate,
    [source, target]: [&[Point]; 2],
    tracked: &[TrackedCluster],
    dt_s: f32,
) -> usize {
    let missed = tracked.iter().filter(|of| of.missed && of.confirmed);
    let missed: Vec<&TrackedCluster> = missed.collect();
    let (Some(ego), false) = (estimate.ego, missed.is_empty()) else {
        return 0;
    };
    let Solution::Objects(solution) = &mut estimate.solution else {
        return 0;
    };
    let objects = &mut solution.objects;
    let finite = target.iter().filter(|p| p.iter().all(|c| c.is_finite()));
    let finite: Vec<Point> = finite.copied().collect();
    let target = ColumnIndex::new(&finite, TRUNCATION_M);
    let mut corrected = 0;
    for of in missed {
        let rows = objects.cluster.iter().enumerate();
        let rows = rows.filter(|&(_, &cluster)| cluster == of.cluster as i32);
        let rows: Vec<usize> = rows.map(|(row, _)| row).collect();
        let points: Vec<Point> = rows.iter().map(|&row| source[row]).collect();
        let mut found = transform_points(&ego, &points);
        for (&row, to) in rows.iter().zip(&mut found) {
            if estimate.valid[row] {
                *to = core::array::from_fn(|a| source[row][a] + estimate.flow[row][a]);
            }
        }
        let object = Carried {
            points,
            bounds: objects.clusters[of.cluster as usize].bounds,
            velocity: of.velocity,
            yaw_rate: of.yaw_rate,
        };
        let moved = object.later(&ego, dt_s).points;
        let farther = farther_m(&target, &found, &moved);
        if farther.iter().sum::<f32>() >= 0.0 {
            continue;
        }
        let way = of.velocity[0].hypot(of.velocity[1]) * dt_s;
        for (at, farther) in around(&object.points, &farther).into_iter().enumerate() {
            if farther <= FARTHER_M && estimate.valid[rows[at]] {
                let flow = core::array::from_fn(|a| moved[at][a] - object.points[at][a]);
                estimate.flow[rows[at]] = flow;
                if let Some(dynamic) = &mut estimate.dynamic {
                    dynamic[rows[at]] = way >= DYNAMIC_M;
                }
                corrected += 1;
            }
        }
        let cluster = &mut objects.clusters[of.cluster as usize];
        cluster.velocity = of.velocity;
        cluster.yaw_rate = of.yaw_rate;
        cluster.dynamic = way >= DYNAMIC_M;
    }
    corrected
}

/// How much farther from the target each point is where it has `moved` than where it was `found`,
/// metres.
fn farther_m(target: &ColumnIndex, found: &[Point], moved: &[Point]) -> Vec<f32> {
    let distance = |point: Point| {
        let nearest = target.nearest(point, TRUNCATION_M);
        nearest.map_or(TRUNCATION_M, |(_, square)| square.sqrt())
    };
    let pairs = found.iter().zip(moved);
    pairs
        .map(|(&found, &moved)| distance(moved) - distance(found))
        .collect()
}

/// The mean of the `values` of the points within [`AROUND_M`] of each point.
fn around(points: &[Point], values: &[f32]) -> Vec<f32> {
    let index = ColumnIndex::new(points, AROUND_M);
    let mean = |&point: &Point| {
        let (mut sum, mut count) = (0.0, 0.0);
        index.within(point, AROUND_M, |row| {
            sum += values[row as usize];
            count += 1.0;
        });
        sum / f32::max(count, 1.0)
    };
    points.iter().map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::cpu::CpuBackend;
    use crate::flow::data::Uncontrolled;
    use crate::flow::estimate::estimate;
    use crate::flow::options::Preset;
    use crate::flow::problem::Problem;
    use crate::flow::simulate::{Street, StreetOptions};

    const DT_S: f32 = 0.1;

    #[test]
    fn a_missed_motion_is_corrected_where_it_leads_to_the_target_and_nowhere_else() {
        let street = Street::new(&StreetOptions {
            beams: 32,
            ..StreetOptions::default()
        });
        let pair = street.and_then(|street| street.pair(0)).expect("a street");
        let backend = CpuBackend::new(None).expect("threads");
        let problem = Problem::pair(&pair.source, &pair.target);
        let options = Preset::Default.options(None);
        let found = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
        let ego = found.ego.expect("it is estimated");
        let objects = found.objects().expect("objects");
        let moving = objects
            .clusters
            .iter()
            .position(|c| c.dynamic && c.points > 100);
        let number = moving.expect("a cluster that moves");
        let rows: Vec<usize> = (0..found.flow.len())
            .filter(|&row| objects.cluster[row] == number as i32)
            .collect();
        let truth = objects.clusters[number];
        // The same estimate, with the motion of the cluster missed.
        let mut missed = found.clone();
        let still = transform_points(&ego, &pair.source);
        for &row in &rows {
            missed.flow[row] = core::array::from_fn(|a| still[row][a] - pair.source[row][a]);
        }
        let of = |velocity: Point, confirmed: bool| TrackedCluster {
            cluster: number as u32,
            id: 1,
            confirmed,
            missed: true,
            velocity,
            yaw_rate: truth.yaw_rate,
        };
        let sweeps = [pair.source.as_slice(), &pair.target];
        let corrected_of = |from: &Estimate, tracked: TrackedCluster| {
            let mut estimate = from.clone();
            let count = correct(&mut estimate, sweeps, &[tracked], DT_S);
            (estimate, count)
        };
        let corrected = |tracked| corrected_of(&missed, tracked);
        let (right, count) = corrected(of(truth.velocity, true));
        assert!(count * 10 > rows.len() * 8, "{count} of {}", rows.len());
        let off = |row: &usize| {
            let off = |a: usize| right.flow[*row][a] - found.flow[*row][a];
            off(0).hypot(off(1)) < 0.05
        };
        let near = rows.iter().filter(|row| off(row)).count();
        assert!(near * 10 > rows.len() * 8, "{near} of {}", rows.len());
        let others = |estimate: &Estimate| -> Vec<Point> {
            let rows = (0..estimate.flow.len()).filter(|row| !rows.contains(row));
            rows.map(|row| estimate.flow[row]).collect()
        };
        assert_eq!(others(&right), others(&missed));
        // A motion that leads away from the target, and an object that may be none.
        let back = truth.velocity.map(|c| -c);
        for wrong in [of(back, true), of(truth.velocity, false)] {
            let (unchanged, count) = corrected(wrong);
            assert_eq!((count, unchanged.flow), (0, missed.flow.clone()));
        }
        // The pair has found a motion that leads nearer to the target.
        let faster = truth.velocity.map(|c| 1.25 * c);
        let (unchanged, count) = corrected_of(&found, of(faster, true));
        assert_eq!((count, unchanged.flow), (0, found.flow.clone()));
    }
}
