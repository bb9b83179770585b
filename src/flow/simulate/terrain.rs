//! The ground: a winding road with a crown, kerbs, sidewalks, side streets and gentle waves.
//!
//! World frame: x along the street where it starts, y to the left, z up.
//!
//! The center line is y = A (1 - cos(x / L)). It is parallel to x at the origin, has the requested
//! curvature there and never intersects itself. Positions are also given as x and lateral offset,
//! metres to the left of the center line.

use nalgebra::{Translation3, UnitQuaternion, Vector3};

use super::shapes::Hit;
use crate::flow::data::{Random, RigidTransform};

/// Distance from the center line to the kerb, metres.
const KERB_M: f64 = 6.0;
/// Height of the sidewalk above the road, metres.
const KERB_HEIGHT_M: f64 = 0.15;
/// Width of the kerb, metres. It keeps the ground continuous.
const KERB_WIDTH_M: f64 = 0.06;
/// Height of the road's middle above its edges, metres.
const CROWN_M: f64 = 0.12;
/// Half-width of side streets, metres.
const SIDE_STREET_M: f64 = 5.0;
/// Distance between side streets, metres.
const BLOCK_M: f64 = 110.0;
/// Maximum slope of the center line against x.
const WINDING: f64 = 0.35;
/// Bounds of the ground height, metres.
const HEIGHTS_M: [f64; 2] = [-0.4, 0.7];

/// The ground of one street.
#[derive(Debug, Clone)]
pub(super) struct Terrain {
    swing: f64,
    length: f64,
    first_side_street: f64,
    phases: [f64; 3],
}

impl Terrain {
    /// Ground whose center line starts with this curvature, 1/m.
    pub(super) fn new(curvature: f64, random: &mut Random) -> Self {
        let length = WINDING / curvature.abs().max(1e-6);
        Self {
            swing: WINDING * length * curvature.signum() * f64::from(u8::from(curvature != 0.0)),
            length,
            first_side_street: random.uniform(26.0, 40.0),
            phases: [0; 3].map(|_| random.uniform(0.0, std::f64::consts::TAU)),
        }
    }

    /// Direction of the center line, radians from x.
    pub(super) fn heading(&self, x: f64) -> f64 {
        (self.swing / self.length * (x / self.length).sin()).atan()
    }

    /// World x and y of a position given by x and lateral offset.
    pub(super) fn position(&self, x: f64, lateral: f64) -> [f64; 2] {
        let (sin, cos) = self.heading(x).sin_cos();
        [x - lateral * sin, self.center(x) + lateral * cos]
    }

    /// The x at the end of a path of `distance` metres along the center line; negative is backward.
    pub(super) fn advance(&self, from: f64, distance: f64) -> f64 {
        let steps = distance.abs().ceil().max(1.0);
        let step = distance / steps;
        (0..steps as usize).fold(from, |x, _| {
            let middle = x + 0.5 * step * self.heading(x).cos();
            x + step * self.heading(middle).cos()
        })
    }

    /// The x of the side street nearest to x.
    pub(super) fn side_street(&self, x: f64) -> f64 {
        let block = ((x - self.first_side_street) / BLOCK_M).round();
        self.first_side_street + block * BLOCK_M
    }

    /// The x of all side streets between two x.
    pub(super) fn side_streets(&self, from: f64, to: f64) -> impl Iterator<Item = f64> {
        let block = ((from - self.first_side_street) / BLOCK_M).ceil();
        let first = self.first_side_street + block * BLOCK_M;
        let streets = (0u32..).map(move |index| first + f64::from(index) * BLOCK_M);
        streets.take_while(move |&x| x < to)
    }

    /// Height of the ground at world x and y, metres.
    pub(super) fn height(&self, x: f64, y: f64) -> f64 {
        let [a, b, c] = self.phases;
        let waves = 0.05 * (x / 13.0 + a).sin() + 0.04 * (y / 11.0 + b).sin();
        let hills = 0.2 * (x / 60.0 + c).sin();
        let (sin, cos) = (x / self.length).sin_cos();
        let slope = self.swing / self.length * sin;
        let offset = y - self.swing * (1.0 - cos);
        let lateral = (offset / (1.0 + slope * slope).sqrt()).abs();
        let off_middle = (lateral / KERB_M).min(1.0);
        let crown = CROWN_M * (1.0 - off_middle * off_middle);
        let beside = ramp((lateral - KERB_M) / KERB_WIDTH_M);
        let kept = ramp((x - self.side_street(x)).abs() - SIDE_STREET_M);
        waves + hills + crown + KERB_HEIGHT_M * beside * kept
    }

    /// Pose of a body of this length and width that stands on the ground.
    pub(super) fn seat(
        &self,
        [x, y]: [f64; 2],
        yaw: f64,
        [length, width]: [f64; 2],
    ) -> RigidTransform {
        let (sin, cos) = yaw.sin_cos();
        let at = |forward: f64, left: f64| {
            self.height(
                x + forward * cos - left * sin,
                y + forward * sin + left * cos,
            )
        };
        let (front, back) = (at(length / 2.0, 0.0), at(-length / 2.0, 0.0));
        let (left, right) = (at(0.0, width / 2.0), at(0.0, -width / 2.0));
        let pitch = ((back - front) / length).atan();
        let roll = ((left - right) / width).atan();
        RigidTransform::from_parts(
            Translation3::new(x, y, (front + back + left + right) / 4.0),
            UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        )
    }

    /// Intersection of a ray from above with the ground, up to a range; world frame, unit
    /// direction.
    pub(super) fn hit(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        max_range: f64,
    ) -> Option<Hit> {
        const STEPS: u32 = 14;
        const HALVINGS: u32 = 13;
        if direction.z >= 0.0 {
            return None;
        }
        let range_at = |height: f64| (height - origin.z) / direction.z;
        let first = range_at(HEIGHTS_M[1]).max(0.0);
        let last = range_at(HEIGHTS_M[0]).min(max_range);
        let above = |range: f64| {
            let point = origin + direction * range;
            point.z - self.height(point.x, point.y)
        };
        let step = (last - first) / f64::from(STEPS);
        let mut free = first;
        let mut blocked = (1..=STEPS).find_map(|index| {
            let range = first + f64::from(index) * step;
            let blocked = above(range) <= 0.0;
            if !blocked {
                free = range;
            }
            blocked.then_some(range)
        })?;
        for _ in 0..HALVINGS {
            let middle = 0.5 * (free + blocked);
            if above(middle) <= 0.0 {
                blocked = middle;
            } else {
                free = middle;
            }
        }
        Some(Hit {
            range: 0.5 * (free + blocked),
            cosine: -direction.z,
        })
    }

    fn center(&self, x: f64) -> f64 {
        self.swing * (1.0 - (x / self.length).cos())
    }
}

/// Smooth step: 0 below 0, 1 above 1.
fn ramp(value: f64) -> f64 {
    let value = value.clamp(0.0, 1.0);
    value * value * (3.0 - 2.0 * value)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn terrain() -> Terrain {
        Terrain::new(0.005, &mut Random::new(4))
    }

    #[test]
    fn the_street_starts_level_with_the_curvature_asked_for() {
        let terrain = terrain();
        assert_eq!(terrain.heading(0.0), 0.0);
        assert!((terrain.heading(1.0) - 0.005).abs() < 1e-5);
        let straight = Terrain::new(0.0, &mut Random::new(4));
        assert_eq!(straight.position(70.0, 2.0), [70.0, 2.0]);
        assert!((straight.advance(5.0, -12.5) + 7.5).abs() < 1e-12);
    }

    #[test]
    fn rays_end_on_the_ground() {
        let terrain = terrain();
        let origin = Vector3::new(1.0, -1.7, 1.9);
        for (x, y, z) in [(1.0, 0.1, -0.3), (0.5, 1.0, -0.15), (1.0, -0.4, -0.04)] {
            let direction = Vector3::new(x, y, z).normalize();
            let hit = terrain.hit(&origin, &direction, 120.0).unwrap();
            let point = origin + direction * hit.range;
            assert!((point.z - terrain.height(point.x, point.y)).abs() < 2e-3);
        }
        assert_eq!(terrain.hit(&origin, &Vector3::x(), 120.0), None);
    }

    #[test]
    fn heights_stay_within_the_bounds_that_rays_rely_on() {
        let terrain = terrain();
        for step in 0..40_000 {
            let (x, y) = (
                f64::from(step % 200) * 2.3 - 150.0,
                f64::from(step / 200) * 0.7 - 70.0,
            );
            let height = terrain.height(x, y);
            assert!((HEIGHTS_M[0]..HEIGHTS_M[1]).contains(&height), "{height}");
        }
    }

    #[test]
    fn side_streets_are_found_by_either_way() {
        let terrain = terrain();
        let streets: Vec<f64> = terrain.side_streets(-130.0, 330.0).collect();
        assert!((4..=5).contains(&streets.len()), "{streets:?}");
        for street in streets {
            assert!((terrain.side_street(street + 40.0) - street).abs() < 1e-9);
        }
    }

    #[test]
    fn the_sidewalk_is_a_kerb_above_the_road() {
        let terrain = terrain();
        let x = terrain.side_street(0.0) + 50.0;
        let [inner, outer] = [5.9, 6.2].map(|lateral| {
            let [x, y] = terrain.position(x, lateral);
            terrain.height(x, y)
        });
        assert!((outer - inner - KERB_HEIGHT_M).abs() < 0.02);
    }
}
