//! What the sweeps saw through: whether their rays passed a place on the way to something farther.
//!
//! Where something stood that the target sees through it has left, and where it stands now it has
//! come if the source saw through there. A wall of which another part is hidden in each sweep does
//! neither: its places are hidden, or it is still there. Rays begin at the origin of a sweep's frame,
//! the sensor or a vehicle around it. It must not know how motions are found.

use std::f32::consts::{FRAC_PI_2, PI};

use crate::flow::data::{Point, RigidTransform, transform_point};

/// Sides of the solid angles that rays are sorted into, radians: two rings of 64 beams are seen
/// together.
const AZIMUTH: f32 = 0.6 * PI / 180.0;
const ELEVATION: f32 = 1.0 * PI / 180.0;
/// Solid angles around, and from below to above.
const AZIMUTHS: usize = 600;
const ELEVATIONS: usize = 180;
/// A ray has passed a place where it ends this much farther out, metres, and metres more for each
/// metre of range.
const PASSED_M: [f32; 2] = [0.2, 0.01];
/// Rays that end nearer than this, metres, hit what carries the sensor, or nothing.
const NEAREST_M: f32 = 0.5;
/// Fewer places with rays to them say nothing, nor do they where there are none to this share.
const PLACES: f32 = 5.0;
const SEEN: f32 = 0.5;

/// What both sweeps of a pair saw through, at places in the target's frame. Where the origin of a
/// sweep's frame is not about where its rays began, as in a map's frame, no ray is seen to pass.
pub(super) struct FreeSpace {
    source: Rays,
    target: Rays,
    source_from_target: RigidTransform,
}

/// What was seen through of the places that a cluster leaves and of those that it comes to: shares;
/// none where there are hardly any such places, or rays to them.
#[derive(Clone, Copy, Debug)]
pub(super) struct FreeSpaceEvidence {
    /// Of what it leaves, in the target.
    pub(super) left: Option<f32>,
    /// Of what it comes to, in the source.
    pub(super) came: Option<f32>,
    /// Whether it goes so far that rays would tell.
    pub(super) far: bool,
}

impl FreeSpace {
    /// Of the source and the target as they came, each in its own frame.
    pub(super) fn new(
        [source, target]: [&[Point]; 2],
        target_from_source: &RigidTransform,
    ) -> Self {
        let (source, target) = rayon::join(|| Rays::new(source), || Rays::new(target));
        Self {
            source,
            target,
            source_from_target: target_from_source.inverse(),
        }
    }

    /// What was seen through of the places that a cluster leaves and of those that it comes to.
    pub(super) fn of(&self, vacated: &[Point], occupied: &[Point], far: bool) -> FreeSpaceEvidence {
        let before = |&place: &Point| {
            self.source
                .passed(transform_point(&self.source_from_target, place))
        };
        FreeSpaceEvidence {
            left: share(vacated.iter().map(|&place| self.target.passed(place))),
            came: share(occupied.iter().map(before)),
            far,
        }
    }
}

/// The rays of one sweep.
struct Rays {
    /// Of each solid angle the end of the shortest ray, metres; infinite where there is none.
    shortest_m: Vec<f32>,
}

impl Rays {
    /// To `points`; one that is not finite is no ray.
    fn new(points: &[Point]) -> Self {
        let mut shortest_m = vec![f32::INFINITY; AZIMUTHS * ELEVATIONS];
        for &point in points {
            let (angle, range_m) = direction(point);
            if range_m >= NEAREST_M {
                shortest_m[angle] = range_m.min(shortest_m[angle]);
            }
        }
        Self { shortest_m }
    }

    /// Whether all rays toward a place passed it; none where there are none.
    fn passed(&self, place: Point) -> Option<bool> {
        let (angle, range_m) = direction(place);
        let end_m = self.shortest_m[angle];
        let is_known = end_m.is_finite() && range_m.is_finite();
        is_known.then(|| end_m > range_m + passed_m(range_m))
    }
}

/// How much farther than a place at this range, metres, a ray ends that passed it, metres.
pub(super) fn passed_m(range_m: f32) -> f32 {
    let [base, slope] = PASSED_M;
    base + slope * range_m
}

/// The solid angle that a place lies in, and its range, metres.
fn direction([x, y, z]: Point) -> (usize, f32) {
    let level = x.hypot(y);
    let azimuth = ((y.atan2(x) + PI) / AZIMUTH) as usize;
    let elevation = ((z.atan2(level) + FRAC_PI_2) / ELEVATION) as usize;
    let angle = azimuth.min(AZIMUTHS - 1) * ELEVATIONS + elevation.min(ELEVATIONS - 1);
    (angle, level.hypot(z))
}

/// The share that passed of those that are known, where enough are.
fn share(places: impl Iterator<Item = Option<bool>>) -> Option<f32> {
    let (mut all, mut known, mut passed) = (0.0, 0.0, 0.0);
    for place in places {
        all += 1.0;
        known += f32::from(place.is_some());
        passed += f32::from(place == Some(true));
    }
    (known >= PLACES && known >= SEEN * all).then(|| passed / known)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall across, 20 m ahead, but for what a pole of half a metre at `pole_y_m` hides of it.
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
        let free_space = FreeSpace::new([&sweeps[0], &sweeps[1]], &RigidTransform::identity());
        let at = |x, y| (0..6_i8).map(|i| [x, y, f32::from(i) * 0.1]).collect();
        let [was, is]: [Vec<Point>; 2] = [at(10.0, 0.0), at(10.0, 1.0)];
        let seen = free_space.of(&was, &is, true);
        assert_eq!((seen.left, seen.came), (Some(1.0), Some(1.0)));
        // What stands is not seen through, nor what the pole hides.
        let seen = free_space.of(&is, &was, true);
        assert_eq!((seen.left, seen.came), (Some(0.0), Some(0.0)));
        let hidden: Vec<Point> = at(20.0, 2.0);
        assert_eq!(free_space.of(&hidden, &[], true).left, Some(0.0));
    }

    #[test]
    fn where_nobody_looked_or_few_places_are_nothing_is_known() {
        let sweep = [sweep(0.0), vec![[0.0; 3], [f32::NAN; 3], [0.1, 0.0, 0.0]]].concat();
        // Straight down behind, where what is not a number would lie.
        let below = [vec![[-0.01, -1e-9, -2.0]], sweep.clone()].concat();
        let free_space = FreeSpace::new([&below, &below], &RigidTransform::identity());
        let seen = |place: Point, count| free_space.of(&vec![place; count], &[], true);
        assert_eq!(seen([10.0, 5.0, 0.0], 6).left, Some(1.0));
        assert_eq!(seen([10.0, 5.0, 0.0], 4).left, None);
        assert_eq!(seen([1.0, 0.0, 8.0], 6).left, None);
        assert_eq!(seen([f32::NAN; 3], 6).left, None);
        assert_eq!(seen([f32::INFINITY, 0.0, 0.0], 6).left, None);
        assert_eq!(seen([10.0, 5.0, 0.0], 6).came, None);
        // What ends at the sensor hides nothing.
        assert_eq!(seen([5.0, 0.0, 0.0], 6).left, Some(1.0));
    }

    #[test]
    fn neighboring_directions_share_an_angle_or_lie_side_by_side() {
        // A little to the left and up of straight ahead, behind on both sides of the seam, above.
        let (ahead, above) = (direction([2.0, 0.01, 0.01]), direction([0.0, 0.0, 2.0]));
        assert_eq!(ahead.0, AZIMUTHS / 2 * ELEVATIONS + ELEVATIONS / 2);
        assert_eq!(above.0 % ELEVATIONS, ELEVATIONS - 1);
        let [left, right] = [0.01, -0.01].map(|y| direction([-2.0, y, 0.01]).0 / ELEVATIONS);
        assert_eq!((left, right), (AZIMUTHS - 1, 0));
    }
}
