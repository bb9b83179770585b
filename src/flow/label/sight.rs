//! What the sweeps saw through: whether their rays passed a place on the way to something farther.
//!
//! Where something stood that the target sees through it has left, and where it stands now it has
//! come if the source saw through there. A wall of which another part is hidden in each sweep does
//! neither: its places are hidden, or it is still there. Rays begin at the origin of a sweep's frame,
//! the sensor or a vehicle around it. It must not know how motions are found.

use std::f32::consts::{FRAC_PI_2, PI};

use crate::flow::points::{Point, RigidTransform, moved};

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
/// Share of the places that there must be rays to.
const SEEN: f32 = 0.5;

/// What both sweeps of a pair saw through, at places in the target's frame.
pub(super) struct Sights {
    source: Rays,
    target: Rays,
    source_from_target: RigidTransform,
}

/// Shares of the places of a cluster that were seen through; none where there are hardly any rays to
/// them.
#[derive(Clone, Copy, Debug)]
pub(super) struct SeenThrough {
    /// Where it was, in the target: it has left.
    pub(super) left: Option<f32>,
    /// Where it is if it moved, in the source: it has come.
    pub(super) came: Option<f32>,
}

impl SeenThrough {
    /// Both shares together; none where one is not known.
    pub(super) fn both(self) -> Option<f32> {
        self.left.zip(self.came).map(|(left, came)| left + came)
    }
}

impl Sights {
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

    /// What was seen through of the places where a cluster `was`, and of those where it `is` after a
    /// motion.
    pub(super) fn of(&self, was: &[Point], is: &[Point]) -> SeenThrough {
        let before = |&place: &Point| self.source.passed(moved(&self.source_from_target, place));
        SeenThrough {
            left: share(was.iter().map(|&place| self.passed(place))),
            came: share(is.iter().map(before)),
        }
    }

    /// Whether the target saw through a place; none where it did not look there.
    pub(super) fn passed(&self, place: Point) -> Option<bool> {
        self.target.passed(place)
    }

    /// Whether a motion of this length, metres, leads from rays that end at a place to rays that have
    /// passed it.
    pub(super) fn tells(length_m: f32, place: Point) -> bool {
        length_m >= 2.0 * passed_m(direction(place).1)
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
            shortest_m[angle] = range_m.min(shortest_m[angle]);
        }
        Self { shortest_m }
    }

    /// Whether all rays toward a place passed it; none where there are none.
    fn passed(&self, place: Point) -> Option<bool> {
        let (angle, range_m) = direction(place);
        let end_m = self.shortest_m[angle];
        end_m
            .is_finite()
            .then(|| end_m > range_m + passed_m(range_m))
    }
}

/// How much farther than a place a ray ends that passed it, metres.
fn passed_m(range_m: f32) -> f32 {
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
    (known > 0.0 && known >= SEEN * all).then(|| passed / known)
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
        let sights = Sights::new([&sweeps[0], &sweeps[1]], &RigidTransform::identity());
        let pole = |y| (0..5_i8).map(|i| [10.0, y, f32::from(i) * 0.1]).collect();
        let [was, is]: [Vec<Point>; 2] = [pole(0.0), pole(1.0)];
        let seen = sights.of(&was, &is);
        assert_eq!((seen.left, seen.came), (Some(1.0), Some(1.0)));
        // What stands is not seen through, nor what the pole hides.
        let hidden: Vec<Point> = (0..5_i8).map(|i| [20.0, 2.0, f32::from(i) * 0.1]).collect();
        let seen = sights.of(&is, &was);
        assert_eq!((seen.left, seen.came), (Some(0.0), Some(0.0)));
        assert_eq!(sights.of(&hidden, &[]).left, Some(0.0));
        assert_eq!(sights.of(&hidden, &[]).came, None);
        // Nobody looked up, and what is not a number is nowhere.
        assert_eq!(sights.of(&[[f32::NAN; 3]], &is).left, None);
        assert_eq!(sights.of(&[[1.0, 0.0, 8.0]], &is).left, None);
    }

    #[test]
    fn every_direction_has_its_solid_angle() {
        let ends = [-1.0_f32, -0.0, 0.0, 1.0];
        let mut angles = Vec::new();
        for x in ends {
            for y in ends {
                for z in ends {
                    angles.push(direction([x, y, z]).0);
                }
            }
        }
        assert!(angles.iter().all(|&angle| angle < AZIMUTHS * ELEVATIONS));
        // A little to the left and up of straight ahead, and above.
        let (ahead, above) = (direction([2.0, 0.01, 0.01]), direction([0.0, 0.0, 2.0]));
        assert_eq!(ahead.0, AZIMUTHS / 2 * ELEVATIONS + ELEVATIONS / 2);
        assert_eq!(above.0 % ELEVATIONS, ELEVATIONS - 1);
    }
}
