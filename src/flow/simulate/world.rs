//! The static world: houses, trees, poles, small obstacles, and parked cars.
//!
//! Objects are placed along the street by the seed, clear of the side streets.

use nalgebra::{Translation3, UnitQuaternion};

use super::objects::{Object, Path};
use super::shapes::Shape;
use super::terrain::Terrain;
use crate::flow::data::{Random, RigidTransform};

/// Distance from the center line to the row of houses, metres.
const HOUSES_M: f64 = 10.5;
/// Extent of the street behind the start and beyond the end of the ego vehicle's path, metres.
const MARGIN_M: f64 = 130.0;

/// A solid of the static world.
#[derive(Debug, Clone)]
pub(super) struct Solid {
    pub(super) shape: Shape,
    pub(super) world_from_solid: RigidTransform,
}

/// The static world of one street.
#[derive(Debug, Default)]
pub(super) struct World {
    pub(super) solids: Vec<Solid>,
    pub(super) parked: Vec<Object>,
}

/// Position relative to the street: along, to the left, and above the ground, metres.
#[derive(Clone, Copy)]
struct Spot {
    x: f64,
    lateral: f64,
    above: f64,
}

impl World {
    /// Builds the street for an ego vehicle that travels this far, metres.
    pub(super) fn new(terrain: &Terrain, travel: f64, random: &mut Random) -> Self {
        let mut world = Self::default();
        let [from, to] = [-MARGIN_M, travel + MARGIN_M];
        for side in [1.0, -1.0] {
            world.add_houses(terrain, [from, to], side, random);
            world.add_side_streets(terrain, [from, to], side);
            world.add_furniture(terrain, [from, to], side, random);
            world.add_parked_cars(terrain, [from, to], side, random);
        }
        world
    }

    fn add_houses(
        &mut self,
        terrain: &Terrain,
        [from, to]: [f64; 2],
        side: f64,
        random: &mut Random,
    ) {
        let mut x = from;
        while x < to {
            let [width, depth] = [random.uniform(8.0, 18.0), random.uniform(8.0, 12.0)];
            let [height, setback] = [random.uniform(5.0, 16.0), random.uniform(0.0, 2.5)];
            let middle = x + width / 2.0;
            let alley = if random.below(4) == 0 {
                random.uniform(2.0, 5.0)
            } else {
                0.1
            };
            x += width + alley;
            if clearance(terrain, middle) < width / 2.0 + 6.0 {
                continue;
            }
            let front = HOUSES_M + setback;
            let lateral = side * (front + depth / 2.0);
            let house = [width / 2.0, depth / 2.0, height / 2.0 + 0.5];
            self.add_box(
                terrain,
                house,
                Spot {
                    x: middle,
                    lateral,
                    above: height / 2.0,
                },
            );

            // Bays and pillars, so that a facade is not a single plane.
            let bays = random.below(5);
            for bay in 0..bays {
                let along = (bay as f64 + 0.5) / bays as f64 - 0.5;
                let out = random.uniform(0.15, 0.7);
                let half = [random.uniform(0.2, 1.1), out / 2.0, height / 2.0];
                let spot = Spot {
                    x: middle + along * width,
                    lateral: side * (front - out / 2.0),
                    above: height / 2.0 + 0.3,
                };
                self.add_box(terrain, half, spot);
            }
            if setback > 1.2 {
                let hedge = [width * 0.4, 0.3, random.uniform(0.4, 0.7)];
                let lateral = side * (HOUSES_M - 0.2);
                self.add_box(
                    terrain,
                    hedge,
                    Spot {
                        x: middle,
                        lateral,
                        above: 0.5,
                    },
                );
            }
        }
    }

    /// Rows of houses along each side street, and a house at its end.
    fn add_side_streets(&mut self, terrain: &Terrain, [from, to]: [f64; 2], side: f64) {
        for corner in terrain.side_streets(from, to) {
            for across in [10.5, -10.5] {
                let row = Spot {
                    x: corner + across,
                    lateral: side * 34.0,
                    above: 4.0,
                };
                self.add_box(terrain, [4.0, 12.0, 5.0], row);
            }
            let end = Spot {
                x: corner,
                lateral: side * 58.0,
                above: 4.0,
            };
            self.add_box(terrain, [12.0, 3.0, 5.0], end);
        }
    }

    fn add_furniture(
        &mut self,
        terrain: &Terrain,
        [from, to]: [f64; 2],
        side: f64,
        random: &mut Random,
    ) {
        let mut x = from;
        while x < to {
            x += random.uniform(5.0, 11.0);
            if clearance(terrain, x) < 7.0 {
                continue;
            }
            match random.below(5) {
                0 | 1 => self.add_tree(terrain, x, side, random),
                2 => {
                    let pole = Shape::Cylinder {
                        radius: 0.09,
                        half_height: 3.2,
                    };
                    self.add(
                        terrain,
                        pole,
                        Spot {
                            x,
                            lateral: side * 6.6,
                            above: 3.0,
                        },
                    );
                }
                3 => {
                    let post = Shape::Cylinder {
                        radius: 0.04,
                        half_height: 1.2,
                    };
                    self.add(
                        terrain,
                        post,
                        Spot {
                            x,
                            lateral: side * 6.5,
                            above: 1.1,
                        },
                    );
                    let sign = [0.02, 0.3, 0.3];
                    self.add_box(
                        terrain,
                        sign,
                        Spot {
                            x,
                            lateral: side * 6.5,
                            above: 2.4,
                        },
                    );
                }
                _ => {
                    let bin = [0.3, 0.3, 0.55].map(|half| half * random.uniform(0.8, 1.5));
                    self.add_box(
                        terrain,
                        bin,
                        Spot {
                            x,
                            lateral: side * 9.9,
                            above: 0.5,
                        },
                    );
                }
            }
        }
    }

    fn add_tree(&mut self, terrain: &Terrain, x: f64, side: f64, random: &mut Random) {
        let lateral = side * 7.2;
        let [trunk, radius] = [random.uniform(2.2, 3.4), random.uniform(0.12, 0.28)];
        let shape = Shape::Cylinder {
            radius,
            half_height: trunk / 2.0 + 0.3,
        };
        self.add(
            terrain,
            shape,
            Spot {
                x,
                lateral,
                above: trunk / 2.0,
            },
        );
        for _ in 0..3 {
            let crown = [1.2, 1.2, 1.0].map(|half| half * random.uniform(0.7, 1.3));
            let spot = Spot {
                x: x + random.uniform(-0.7, 0.7),
                lateral: lateral + random.uniform(-0.7, 0.7),
                above: trunk + random.uniform(0.3, 1.5),
            };
            self.add(terrain, Shape::Ellipsoid(crown), spot);
        }
    }

    fn add_parked_cars(
        &mut self,
        terrain: &Terrain,
        [from, to]: [f64; 2],
        side: f64,
        random: &mut Random,
    ) {
        let mut x = from;
        while x < to {
            x += random.uniform(5.6, 6.6);
            if random.below(5) < 2 || clearance(terrain, x) < 9.0 {
                continue;
            }
            let lateral = side * random.uniform(4.75, 5.0);
            let path = Path::Along {
                x,
                lateral,
                speed: 0.0,
            };
            self.parked.push(Object::car(path, random));
        }
    }

    fn add_box(&mut self, terrain: &Terrain, half: [f64; 3], spot: Spot) {
        self.add(terrain, Shape::Box(half), spot);
    }

    fn add(&mut self, terrain: &Terrain, shape: Shape, spot: Spot) {
        let [x, y] = terrain.position(spot.x, spot.lateral);
        let position = Translation3::new(x, y, terrain.height(x, y) + spot.above);
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, terrain.heading(spot.x));
        self.solids.push(Solid {
            shape,
            world_from_solid: RigidTransform::from_parts(position, turn),
        });
    }
}

/// Distance to the middle of the nearest side street, metres.
fn clearance(terrain: &Terrain, x: f64) -> f64 {
    (x - terrain.side_street(x)).abs()
}
