//! Cars, cyclists and pedestrians: their shapes and trajectories.
//!
//! Every object is rigid.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::Vector3;

use super::shapes::Shape;
use super::terrain::Terrain;
use crate::flow::data::{Random, RigidTransform};

/// Lateral offset of a lane's middle from the center line, metres; traffic keeps to the right.
pub(super) const LANE_M: f64 = 1.75;
/// Spacing of the cars in a lane, metres.
const SPACING_M: f64 = 14.0;

/// Type of an object of a simulated street.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A car, parked or driving.
    Car,
    /// A person on a bicycle.
    Cyclist,
    /// A person on foot.
    Pedestrian,
}

/// Trajectory of an object; distances in metres, speeds in m/s.
#[derive(Debug, Clone, Copy)]
pub(super) enum Path {
    /// Along the street at a lateral offset. A negative speed is against the direction of the
    /// street.
    Along { x: f64, lateral: f64, speed: f64 },
    /// Straight, then a quarter turn (to the left for a positive radius), then straight.
    Turn {
        from: [f64; 2],
        yaw: f64,
        straight: f64,
        radius: f64,
        speed: f64,
    },
}

impl Path {
    /// World x and y, metres, and yaw, radians, at a time in seconds.
    fn at(&self, terrain: &Terrain, seconds: f64) -> ([f64; 2], f64) {
        match *self {
            Path::Along { x, lateral, speed } => {
                let x = terrain.advance(x, speed * seconds);
                let back = if speed < 0.0 { PI } else { 0.0 };
                (terrain.position(x, lateral), terrain.heading(x) + back)
            }
            Path::Turn {
                from,
                yaw,
                straight,
                radius,
                speed,
            } => {
                let run = speed * seconds;
                let turned = ((run - straight) / radius.abs()).clamp(0.0, FRAC_PI_2);
                let before = run.min(straight);
                let after = (run - straight - radius.abs() * FRAC_PI_2).max(0.0);
                let forward = before + radius.abs() * turned.sin() + after * turned.cos();
                let left =
                    radius.signum() * (radius.abs() * (1.0 - turned.cos()) + after * turned.sin());
                let (sin, cos) = yaw.sin_cos();
                let position = [
                    from[0] + forward * cos - left * sin,
                    from[1] + forward * sin + left * cos,
                ];
                (position, yaw + radius.signum() * turned)
            }
        }
    }
}

/// A rigid object.
#[derive(Debug, Clone)]
pub(super) struct Object {
    pub(super) kind: Kind,
    /// Solids and their centers in the object's frame: x forward, z up from the ground.
    pub(super) parts: Vec<(Shape, Vector3<f64>)>,
    /// Length and width of its footprint on the ground, metres.
    stand: [f64; 2],
    path: Path,
}

impl Object {
    /// A car of random size.
    pub(super) fn car(path: Path, random: &mut Random) -> Self {
        let [length, width] = [random.uniform(3.8, 4.9), random.uniform(1.7, 1.9)];
        let roof = random.uniform(1.4, 1.75);
        let body = Shape::Box([length / 2.0, width / 2.0, 0.33]);
        let cabin = Shape::Box([length * 0.27, width * 0.44, (roof - 0.88) / 2.0]);
        Self {
            kind: Kind::Car,
            parts: vec![
                (body, Vector3::new(0.0, 0.0, 0.55)),
                (cabin, Vector3::new(-0.1 * length, 0.0, (roof + 0.88) / 2.0)),
            ],
            stand: [length * 0.6, width],
            path,
        }
    }

    fn cyclist(path: Path) -> Self {
        let frame = Shape::Box([0.85, 0.05, 0.45]);
        let rider = Shape::Ellipsoid([0.3, 0.24, 0.45]);
        let head = Shape::Ellipsoid([0.12, 0.1, 0.14]);
        Self {
            kind: Kind::Cyclist,
            parts: vec![
                (frame, Vector3::new(0.0, 0.0, 0.5)),
                (rider, Vector3::new(-0.1, 0.0, 1.2)),
                (head, Vector3::new(0.1, 0.0, 1.7)),
            ],
            stand: [1.2, 0.5],
            path,
        }
    }

    fn pedestrian(path: Path, random: &mut Random) -> Self {
        let shoulder = random.uniform(1.3, 1.55);
        let body = Shape::Cylinder {
            radius: random.uniform(0.2, 0.28),
            half_height: shoulder / 2.0,
        };
        let head = Shape::Ellipsoid([0.11, 0.1, 0.14]);
        Self {
            kind: Kind::Pedestrian,
            parts: vec![
                (body, Vector3::new(0.0, 0.0, shoulder / 2.0 + 0.02)),
                (head, Vector3::new(0.0, 0.0, shoulder + 0.16)),
            ],
            stand: [0.5, 0.5],
            path,
        }
    }

    /// The least and the largest coordinates of its solids in its frame, metres.
    pub(super) fn extent(&self) -> [[f64; 3]; 2] {
        let sides = |axis: usize| {
            let parts = self.parts.iter();
            parts.map(move |(shape, center)| (center[axis], shape.half_extents()[axis]))
        };
        let low = |axis| {
            sides(axis)
                .map(|(c, h)| c - h)
                .fold(f64::INFINITY, f64::min)
        };
        let high = |axis| {
            sides(axis)
                .map(|(c, h)| c + h)
                .fold(f64::NEG_INFINITY, f64::max)
        };
        [core::array::from_fn(low), core::array::from_fn(high)]
    }

    /// Pose of the object, world_from_object, at a time in seconds.
    pub(super) fn pose(&self, terrain: &Terrain, seconds: f64) -> RigidTransform {
        let (position, yaw) = self.path.at(terrain, seconds);
        terrain.seat(position, yaw, self.stand)
    }
}

/// The moving objects around the start of the street. The first is always an oncoming car nearby.
pub(super) fn traffic(
    movers: usize,
    ego_speed: f64,
    terrain: &Terrain,
    random: &mut Random,
) -> Vec<Object> {
    let oncoming_speed = random.uniform(6.0, 12.0);
    // Cars in the ego vehicle's lane drive at its speed, so that they do not collide in a long
    // sequence.
    let lane_speed = if ego_speed >= 1.0 { ego_speed } else { 5.0 };
    let mut oncoming_slots = slots(movers, random);
    let mut lane_slots = slots(movers, random);
    let corner = terrain.side_street(0.0);
    let object = |index: usize| {
        let side = if random.below(2) == 0 { 1.0 } else { -1.0 };
        let round = (index / 8) as f64;
        match index % 8 {
            0 | 4 => {
                let x = oncoming_slots.pop().unwrap_or(0.0) + random.uniform(0.0, 4.0);
                let (lateral, speed) = (LANE_M, -oncoming_speed);
                Object::car(Path::Along { x, lateral, speed }, random)
            }
            2 => {
                let x = lane_slots.pop().unwrap_or(SPACING_M) + random.uniform(-1.0, 1.0);
                let (lateral, speed) = (-LANE_M, lane_speed);
                Object::car(Path::Along { x, lateral, speed }, random)
            }
            3 => {
                let x = random.uniform(-25.0, 40.0);
                let speed = -side * random.uniform(3.0, 6.5);
                let lateral = side * 3.2;
                Object::cyclist(Path::Along { x, lateral, speed })
            }
            5 => Object::car(joining(terrain, corner, round, random), random),
            7 => Object::car(crossing(terrain, corner, [side, round], random), random),
            _ => {
                let x = random.uniform(-20.0, 30.0);
                let lateral = side * random.uniform(8.0, 9.2);
                let pace = random.uniform(0.8, 1.7);
                let speed = if random.below(2) == 0 { pace } else { -pace };
                Object::pedestrian(Path::Along { x, lateral, speed }, random)
            }
        }
    };
    (0..movers).map(object).collect()
}

/// Positions of the cars of a lane, metres along the street: the nearest ones ahead and behind, in
/// random order.
fn slots(cars: usize, random: &mut Random) -> Vec<f64> {
    let position = |slot: usize| {
        let distance = SPACING_M * (slot / 2 + 1) as f64;
        if slot.is_multiple_of(2) {
            distance
        } else {
            -distance
        }
    };
    let mut slots: Vec<f64> = (0..cars / 4 + 3).map(position).collect();
    random.shuffle(&mut slots);
    slots
}

/// Trajectory out of the side street on the right, turning right into the ego vehicle's lane.
fn joining(terrain: &Terrain, corner: f64, round: f64, random: &mut Random) -> Path {
    let radius = 6.5;
    let straight = SPACING_M * round;
    let run_up = -LANE_M - radius - straight + random.uniform(0.0, 4.0);
    let from = terrain.position(corner + LANE_M, run_up);
    Path::Turn {
        from,
        yaw: terrain.heading(corner) + FRAC_PI_2,
        straight,
        radius: -radius,
        speed: random.uniform(3.5, 6.0),
    }
}

/// Trajectory across the street, from one side street to the other.
fn crossing(terrain: &Terrain, corner: f64, [side, round]: [f64; 2], random: &mut Random) -> Path {
    let start = -side * (random.uniform(8.0, 14.0) + SPACING_M * round);
    Path::Turn {
        from: terrain.position(corner + side * LANE_M, start),
        yaw: terrain.heading(corner) + side * FRAC_PI_2,
        straight: f64::MAX,
        radius: 1.0,
        speed: random.uniform(3.5, 7.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_is_continuous_and_keeps_its_speed() {
        let terrain = Terrain::new(0.0, &mut Random::new(1));
        let path = Path::Turn {
            from: [3.0, -10.0],
            yaw: FRAC_PI_2,
            straight: 2.0,
            radius: -6.0,
            speed: 5.0,
        };
        for step in 0..400 {
            let seconds = f64::from(step) * 0.01;
            let (a, yaw) = path.at(&terrain, seconds);
            let (b, next) = path.at(&terrain, seconds + 0.01);
            let run = (b[0] - a[0]).hypot(b[1] - a[1]);
            assert!((run - 0.05).abs() < 1e-5, "{run}");
            assert!((next - yaw).abs() < 0.01);
            let ahead = (b[1] - a[1]).atan2(b[0] - a[0]);
            assert!((ahead - yaw).abs() < 0.01);
        }
        assert!(path.at(&terrain, 4.0).1.abs() < 1e-12);
    }

    #[test]
    fn the_first_mover_is_an_oncoming_car_nearby() {
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let terrain = Terrain::new(0.002, &mut random);
            let objects = traffic(1, 8.0, &terrain, &mut random);
            let pose = objects[0].pose(&terrain, 0.0).translation.vector;
            assert_eq!((objects.len(), objects[0].kind), (1, Kind::Car));
            assert!(pose.xy().norm() < 35.0);
        }
    }
}
