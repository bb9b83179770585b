//! Deskewing: the points of a sweep, measured one after the other, as the sensor would see them at
//! one instant.
//!
//! The sensor is taken to move at constant velocity, on a screw, from the time of the source to the
//! time of the target. With the ego motion E, target_from_source, a point p measured t seconds
//! after the time of its sweep is exp(-(t / dt) log E) p in the sensor's frame of that time.

use rayon::prelude::*;

use super::data::{Point, RigidTransform, Screw, transform_point};
use super::spatial::{ColumnIndex, voxel_first};

/// Horizontal distance from the sensor within which the fit is measured, metres. The error of a
/// static point that was not deskewed falls with its distance.
const NEAR_M: f32 = 15.0;
/// Side of the voxels that points are sampled from, metres.
const VOXEL_M: f32 = 0.3;
/// Distances are truncated here, metres.
const TRUNCATION_M: f32 = 0.3;

/// The points of a sweep in the sensor's frame of the sweep's time.
///
/// `points` are N points in metres, each in the sensor's frame of its own time. `times` are N times
/// in seconds after the sweep's time. `ego` is the motion of the sensor in `elapsed_s` seconds,
/// target_from_source. `elapsed_s` is below zero where the target is the earlier sweep.
pub(crate) fn deskewed(
    points: &[Point],
    times: &[f32],
    ego: &RigidTransform,
    elapsed_s: f32,
) -> Vec<Point> {
    let screw = Screw::of(&ego.inverse());
    let share = |time: f32| f64::from(time) / f64::from(elapsed_s);
    let move_back = |(&point, &time)| transform_point(&screw.at(share(time)), point);
    points.par_iter().zip(times).map(move_back).collect()
}

/// A source whose fit to a target is compared before and after it is deskewed.
///
/// The measure is the mean distance of near points off the ground from the target after the ego
/// motion. The registration does not minimize it.
pub(crate) struct Fit<'a> {
    /// Source rows of the points that are measured: near, off the ground, evenly spread over space.
    rows: Vec<usize>,
    /// M flags: true for ground points of the target.
    ground: &'a [bool],
}

impl<'a> Fit<'a> {
    /// Chooses the points of `source`, N points in metres. `ground` has N and M flags.
    pub(crate) fn new(source: &[Point], ground: [&'a [bool]; 2]) -> Self {
        let near = rows_within(source, ground[0], NEAR_M);
        let points: Vec<Point> = near.iter().map(|&row| source[row]).collect();
        let chosen = voxel_first(&points, VOXEL_M).into_iter();
        Self {
            rows: chosen.map(|index| near[index as usize]).collect(),
            ground: ground[1],
        }
    }

    /// The mean distance of the chosen points, metres, truncated. Zero of no points. `source` and
    /// `target` are all points of the two sweeps, and `ego` is target_from_source.
    pub(crate) fn distance_m(
        &self,
        source: &[Point],
        target: &[Point],
        ego: &RigidTransform,
    ) -> f32 {
        let reached = rows_within(target, self.ground, 2.0 * NEAR_M);
        let reached: Vec<Point> = reached.into_iter().map(|row| target[row]).collect();
        let index = ColumnIndex::new(&reached, TRUNCATION_M);
        let distance = |&row: &usize| {
            let moved = transform_point(ego, source[row]);
            let nearest = index.nearest(moved, TRUNCATION_M);
            nearest.map_or(TRUNCATION_M, |(_, square)| square.sqrt())
        };
        let distances: Vec<f32> = self.rows.par_iter().map(distance).collect();
        distances.iter().sum::<f32>() / distances.len().max(1) as f32
    }
}

/// Rows of the points that are finite, within `reach_m` of the sensor horizontally, and not ground.
fn rows_within(points: &[Point], ground: &[bool], reach_m: f32) -> Vec<usize> {
    let is_near = |&row: &usize| {
        let [x, y, z] = points[row];
        x.hypot(y) < reach_m && z.is_finite() && ground.get(row) != Some(&true)
    };
    (0..points.len()).filter(is_near).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::simulate::{Street, StreetOptions};

    #[test]
    fn the_true_ego_motion_leads_a_rolling_sweep_back_to_one_instant() {
        // The vehicle follows a winding street, not a screw.
        const TOLERANCE_M: f32 = 0.01;
        let street = StreetOptions {
            seed: 3,
            beams: 16,
            speed_mps: Some(20.0),
            yaw_rate_rps: Some(0.2),
            rolling: true,
            ..StreetOptions::default()
        };
        let street = Street::new(&street).expect("a street");
        let [first, second] = [0, 1].map(|index| street.sweep(index).expect("a sweep"));
        let ego = second.world_from_sensor.inv_mul(&first.world_from_sensor);
        let times = first.times.clone().expect("a rolling sweep");
        let found = deskewed(&first.points, &times, &ego, 0.1);
        let expected = street.deskewed(&first);
        let farthest = |a: &[Point], b: &[Point]| {
            let off =
                |(a, b): (&Point, &Point)| (0..3).map(|i| (a[i] - b[i]).abs()).fold(0.0, f32::max);
            a.iter().zip(b).map(off).fold(0.0, f32::max)
        };
        let off = farthest(&found, &expected);
        assert!(off < TOLERANCE_M, "{off}");
        assert!(farthest(&first.points, &expected) > 1.5);
        // From the later sweep to the earlier one.
        let times = second.times.clone().expect("a rolling sweep");
        let found = deskewed(&second.points, &times, &ego.inverse(), -0.1);
        let off = farthest(&found, &street.deskewed(&second));
        assert!(off < TOLERANCE_M, "{off}");
    }

    #[test]
    fn near_points_fit_better_after_their_own_motion_alone() {
        let street = StreetOptions {
            seed: 5,
            speed_mps: Some(30.0),
            rolling: true,
            ..StreetOptions::default()
        };
        let pair = Street::new(&street)
            .and_then(|street| street.pair(0))
            .expect("a pair");
        let ego = pair.target_from_source;
        let [source, target] = pair.times.as_ref().expect("a rolling pair");
        let clouds = [
            deskewed(&pair.source, source, &ego, 0.1),
            deskewed(&pair.target, target, &ego, 0.1),
        ];
        let fit = Fit::new(&pair.source, [&pair.ground_source, &pair.ground_target]);
        let apart = fit.distance_m(&pair.source, &pair.target, &ego);
        let fitted = fit.distance_m(&clouds[0], &clouds[1], &ego);
        assert!(fitted < apart, "{fitted} {apart}");
        let twice = [
            deskewed(&clouds[0], source, &ego, 0.1),
            deskewed(&clouds[1], target, &ego, 0.1),
        ];
        assert!(fit.distance_m(&twice[0], &twice[1], &ego) > fitted);
        assert_eq!(
            Fit::new(&[], [&[]; 2]).distance_m(&[], &pair.target, &ego),
            0.0
        );
    }
}
