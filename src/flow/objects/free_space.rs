//! Free-space evidence: whether rays of a sweep passed through a position to a return farther out.
//!
//! A cluster has left a position if rays of the target pass through it. It has come to a position
//! if rays of the source passed through it. A static wall shows neither: each sweep hides a
//! different part of it, and its positions are hidden or still occupied. Rays begin at the origin
//! of a sweep's frame, which must be at the sensor or on the vehicle around it.

use std::f32::consts::{FRAC_PI_2, PI};

use crate::flow::data::{Point, RigidTransform, Screw, atan2, floors, transform_point};

/// Sides of the solid angles that rays are binned into, radians. Two rings of a 64-beam lidar fall
/// into one bin.
const AZIMUTH: f32 = 0.6 * PI / 180.0;
const ELEVATION: f32 = 1.0 * PI / 180.0;
/// Number of bins in azimuth, and in elevation from nadir to zenith.
const AZIMUTHS: usize = 600;
const ELEVATIONS: usize = 180;
/// Points whose directions are computed at once.
const AT_ONCE: usize = 16;
/// A ray has passed a position where it ends farther out by this: metres, and metres per metre of
/// range.
const PASSED_M: [f32; 2] = [0.2, 0.01];
/// Returns nearer than this, metres, are the vehicle or invalid.
const NEAREST_M: f32 = 0.5;
/// Least number of positions with rays toward them, and their least share of all positions, for a
/// result.
const PLACES: f32 = 5.0;
const SEEN: f32 = 0.5;

/// The rays of both sweeps of a pair, for positions in the target's frame. Where the origin of a
/// sweep's frame is far from the sensor, as in a map's frame, no ray counts as passing.
pub(super) struct FreeSpace {
    source: Rays,
    target: Rays,
    source_from_target: RigidTransform,
}

/// Free-space evidence for a cluster's motion: shares of the vacated positions (those that it
/// leaves) and of the occupied ones (those that it comes to). A share is none where there are too
/// few positions with rays toward them.
#[derive(Clone, Copy, Debug)]
pub(super) struct FreeSpaceEvidence {
    /// Share of the vacated positions that rays of the target passed through.
    pub(super) left: Option<f32>,
    /// Share of the occupied positions that rays of the source passed through.
    pub(super) came: Option<f32>,
    /// Whether the displacement is long enough for rays to discriminate.
    pub(super) far: bool,
}

impl FreeSpace {
    /// From the raw source and target, metres, each in its own frame. `times` are those of
    /// [`super::SearchClouds::times`].
    pub(super) fn new(
        sweeps: [&[Point]; 2],
        times: Option<[&[f32]; 2]>,
        target_from_source: &RigidTransform,
    ) -> Self {
        let source_from_target = target_from_source.inverse();
        let path = Screw::of(&source_from_target);
        let rays = |sweep: usize| {
            let columns = times.map(|times| Columns::new(sweeps[sweep], times[sweep], &path));
            Rays::new(sweeps[sweep], columns)
        };
        let (source, target) = rayon::join(|| rays(0), || rays(1));
        Self {
            source,
            target,
            source_from_target,
        }
    }

    /// The evidence for a motion from the `vacated` positions to the `occupied` ones, metres in the
    /// target's frame.
    pub(super) fn of(&self, vacated: &[Point], occupied: &[Point], far: bool) -> FreeSpaceEvidence {
        let before = |&position: &Point| {
            self.source
                .passed(transform_point(&self.source_from_target, position))
        };
        FreeSpaceEvidence {
            left: share(vacated.iter().map(|&position| self.target.passed(position))),
            came: share(occupied.iter().map(before)),
            far,
        }
    }
}

/// The rays of one sweep.
struct Rays {
    /// For each bin, the range of the nearest return, metres; infinite where there is none.
    shortest_m: Vec<f32>,
    /// The sensor's motion during the sweep; none for a sweep that is taken at one instant.
    columns: Option<Columns>,
}

/// The poses of a moving sensor by azimuth.
struct Columns {
    /// For each bin in azimuth, the transform from the sweep's frame to the sensor's frame at the
    /// mean time of the points there.
    measured_from_sweep: Vec<RigidTransform>,
}

impl Columns {
    /// From the raw points of a sweep and their times in sweep intervals. `path` is the sensor's
    /// motion in one interval, earlier_from_later.
    fn new(points: &[Point], times: &[f32], path: &Screw) -> Self {
        let mut sums = vec![[0.0_f64; 2]; AZIMUTHS];
        for (&point, &time) in points.iter().zip(times) {
            let (angle, range_m) = direction(point);
            if range_m.is_finite() && range_m >= NEAREST_M && time.is_finite() {
                let sum = &mut sums[angle / ELEVATIONS];
                *sum = [sum[0] + f64::from(time), sum[1] + 1.0];
            }
        }
        let mut last = RigidTransform::identity();
        let poses = sums.into_iter().map(|[sum, count]| {
            if count > 0.0 {
                last = path.at(sum / count).inverse();
            }
            last
        });
        Self {
            measured_from_sweep: poses.collect(),
        }
    }

    /// A position of the sweep's frame in the sensor's frame of the time at which the sensor looked
    /// there.
    fn as_measured(&self, position: Point) -> Point {
        // The direction depends on the time, and the time on the direction.
        const STEPS: usize = 2;
        (0..STEPS).fold(position, |seen, _| {
            let (angle, _) = direction(seen);
            transform_point(&self.measured_from_sweep[angle / ELEVATIONS], position)
        })
    }
}

impl Rays {
    /// Rays to `points`. Points that are not finite are ignored.
    fn new(points: &[Point], columns: Option<Columns>) -> Self {
        let mut shortest_m = vec![f32::INFINITY; AZIMUTHS * ELEVATIONS];
        let mut see = |(angle, range_m): (usize, f32)| {
            if range_m >= NEAREST_M {
                shortest_m[angle] = range_m.min(shortest_m[angle]);
            }
        };
        let (together, rest) = points.as_chunks::<AT_ONCE>();
        for points in together {
            directions(points).into_iter().for_each(&mut see);
        }
        for &point in rest {
            see(direction(point));
        }
        Self {
            shortest_m,
            columns,
        }
    }

    /// Whether all rays toward a position passed it; none where there are no rays.
    fn passed(&self, position: Point) -> Option<bool> {
        let columns = self.columns.as_ref();
        let position = columns.map_or(position, |columns| columns.as_measured(position));
        let (angle, range_m) = direction(position);
        let end_m = self.shortest_m[angle];
        let is_known = end_m.is_finite() && range_m.is_finite();
        is_known.then(|| end_m > range_m + passed_m(range_m))
    }
}

/// How much farther than a position at this range, metres, a ray must end to have passed it,
/// metres.
pub(super) fn passed_m(range_m: f32) -> f32 {
    let [base, slope] = PASSED_M;
    base + slope * range_m
}

/// The bin of a position's direction, and its range, metres.
fn direction(position: Point) -> (usize, f32) {
    directions(&[position])[0]
}

/// [`direction`] of several positions, by vector instructions.
#[inline(always)]
fn directions<const N: usize>(positions: &[Point; N]) -> [(usize, f32); N] {
    let (mut azimuths, mut elevations, mut ranges) = ([0.0; N], [0.0; N], [0.0; N]);
    for (i, &[x, y, z]) in positions.iter().enumerate() {
        let square = x * x + y * y;
        azimuths[i] = (atan2(y, x) + PI) / AZIMUTH;
        elevations[i] = (atan2(z, square.sqrt()) + FRAC_PI_2) / ELEVATION;
        ranges[i] = (square + z * z).sqrt();
    }
    let azimuths = floors(azimuths, [0.0, (AZIMUTHS - 1) as f32]);
    let elevations = floors(elevations, [0.0, (ELEVATIONS - 1) as f32]);
    let mut directions = [(0, 0.0); N];
    for (i, direction) in directions.iter_mut().enumerate() {
        let bin = azimuths[i] * ELEVATIONS as i32 + elevations[i];
        *direction = (bin as usize, ranges[i]);
    }
    directions
}

/// The share that rays passed, of the positions with rays toward them; none where there are too
/// few.
fn share(positions: impl Iterator<Item = Option<bool>>) -> Option<f32> {
    let (mut all, mut known, mut passed) = (0.0, 0.0, 0.0);
    for position in positions {
        all += 1.0;
        known += f32::from(position.is_some());
        passed += f32::from(position == Some(true));
    }
    (known >= PLACES && known >= SEEN * all).then(|| passed / known)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall 20 m ahead, and a pole of 0.5 m at `pole_y_m` in front, which hides a part of it.
    fn sweep(pole_y_m: f32) -> Vec<Point> {
        let mut points = Vec::new();
        for across in -400_i16..400 {
            for up in -10_i16..10 {
                let [y, z] = [f32::from(across) * 0.025, f32::from(up) * 0.1];
                let hit = (y / 2.0 - pole_y_m).abs() < 0.25;
                // The pole is half-way to the wall.
                let near = if hit { 0.5 } else { 1.0 };
                points.push([20.0, y, z].map(|c| c * near));
            }
        }
        points
    }

    #[test]
    fn a_pole_has_left_where_the_wall_behind_is_seen_and_come_where_it_was() {
        let sweeps = [sweep(0.0), sweep(1.0)];
        let free_space =
            FreeSpace::new([&sweeps[0], &sweeps[1]], None, &RigidTransform::identity());
        let at = |x, y| (0..6_i8).map(|i| [x, y, f32::from(i) * 0.1]).collect();
        let [was, is]: [Vec<Point>; 2] = [at(10.0, 0.0), at(10.0, 1.0)];
        let seen = free_space.of(&was, &is, true);
        assert_eq!((seen.left, seen.came), (Some(1.0), Some(1.0)));
        // Rays pass neither the pole nor the part of the wall that it hides.
        let seen = free_space.of(&is, &was, true);
        assert_eq!((seen.left, seen.came), (Some(0.0), Some(0.0)));
        let hidden: Vec<Point> = at(20.0, 2.0);
        assert_eq!(free_space.of(&hidden, &[], true).left, Some(0.0));
    }

    #[test]
    fn rays_of_a_moving_sensor_begin_where_it_was() {
        // The sensor moves 2 m to the left in an interval, and looks ahead at the middle of it: it
        // sees the pole 1 m to the right of where it is.
        let mut raw = sweep(0.0);
        let path = RigidTransform::translation(0.0, 2.0, 0.0);
        let mut times = vec![0.5; raw.len()];
        // NaN times are ignored.
        for time in times.iter_mut().step_by(7) {
            *time = f32::NAN;
        }
        // Some drivers write the origin where there is no return.
        raw.extend(vec![[0.0; 3]; 10_000]);
        times.extend(vec![0.0; 10_000]);
        let sweeps = [raw.as_slice(); 2];
        let free_space = FreeSpace::new(sweeps, Some([&times; 2]), &path.inverse());
        let at = |y| -> Vec<Point> { (0..6_i8).map(|i| [10.0, y, f32::from(i) * 0.1]).collect() };
        // In the target's frame, at its time.
        assert_eq!(free_space.of(&at(1.0), &[], true).left, Some(0.0));
        assert_eq!(free_space.of(&at(0.0), &[], true).left, Some(1.0));
        assert_eq!(free_space.of(&at(2.0), &[], true).left, Some(1.0));
    }

    #[test]
    fn where_nobody_looked_or_few_places_are_nothing_is_known() {
        let sweep = [sweep(0.0), vec![[0.0; 3], [f32::NAN; 3], [0.1, 0.0, 0.0]]].concat();
        // Straight down and behind: the bin that a direction that is not a number falls into.
        let below = [vec![[-0.01, -1e-9, -2.0]], sweep.clone()].concat();
        let free_space = FreeSpace::new([&below, &below], None, &RigidTransform::identity());
        let seen = |position: Point, count| free_space.of(&vec![position; count], &[], true);
        assert_eq!(seen([10.0, 5.0, 0.0], 6).left, Some(1.0));
        assert_eq!(seen([10.0, 5.0, 0.0], 4).left, None);
        assert_eq!(seen([1.0, 0.0, 8.0], 6).left, None);
        assert_eq!(seen([f32::NAN; 3], 6).left, None);
        assert_eq!(seen([f32::INFINITY, 0.0, 0.0], 6).left, None);
        assert_eq!(seen([10.0, 5.0, 0.0], 6).came, None);
        // A return at the sensor hides nothing.
        assert_eq!(seen([5.0, 0.0, 0.0], 6).left, Some(1.0));
    }

    #[test]
    fn neighboring_directions_share_an_angle_or_lie_side_by_side() {
        // Slightly to the left of and above straight ahead; behind, on both sides of the seam;
        // straight up.
        let (ahead, above) = (direction([2.0, 0.01, 0.01]), direction([0.0, 0.0, 2.0]));
        assert_eq!(ahead.0, AZIMUTHS / 2 * ELEVATIONS + ELEVATIONS / 2);
        assert_eq!(above.0 % ELEVATIONS, ELEVATIONS - 1);
        let [left, right] = [0.01, -0.01].map(|y| direction([-2.0, y, 0.01]).0 / ELEVATIONS);
        assert_eq!((left, right), (AZIMUTHS - 1, 0));
    }
}
