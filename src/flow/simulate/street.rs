//! Simulated street over time: sweeps, and the exact flow of every point.
//!
//! The true flow is that of the measured point, noise included: it moves rigidly with the object or
//! surface that the ray hit, and the ego vehicle moves as well. For a static point x2 = T x1.
//!
//! A point of a rolling sweep is measured at a time of its own. Its position p in the sensor's frame
//! of that time is deskewed to x1, its position in the sensor's frame of the sweep's time. The flow
//! starts at x1 and takes one sweep interval.

use std::ops::Range;

use nalgebra::{Point3, Translation3, Vector3};

use super::lidar::{Lidar, View};
use super::objects::{Kind, LANE_M, Object, traffic};
use super::options::{SWEEP_SECONDS, StreetError, StreetOptions};
use super::scene::Target;
use super::suspension::Suspension;
use super::terrain::Terrain;
use super::view;
use super::world::World;
use crate::flow::data::{OrientedBox, Point, Random, RigidTransform, transform_point};
use crate::flow::depth::{Camera, DepthImage};
use crate::flow::tracks::{Track, TrackState};

/// Height of the sensor above the ground, metres.
const SENSOR_HEIGHT_M: f64 = 1.73;
/// Wheelbase and track of the ego vehicle, metres.
const EGO_STAND_M: [f64; 2] = [2.7, 1.6];
/// Distinguishes the random numbers of the vehicle's springs from those of the street.
const SPRINGS: u64 = 0x5350_5249_4e47_5321;
/// Instants of a rolling sweep.
const INSTANTS: usize = 125;
/// Minimum residual displacement of a dynamic point, metres per sweep interval.
const DYNAMIC_M: f64 = 0.05;

/// A simulated street with traffic, scanned by a spinning lidar on an ego vehicle that drives along
/// it.
///
/// The exact motion of every point is known. Times are counted in sweep intervals of
/// [`SWEEP_SECONDS`] since the first sweep. The options determine all data.
#[derive(Debug)]
pub struct Street {
    sweeps: usize,
    speed: f64,
    rolling: bool,
    /// Springs of the ego vehicle.
    suspension: Option<Suspension>,
    terrain: Terrain,
    world: World,
    /// Moving objects.
    movers: Vec<Object>,
    lidar: Lidar,
}

/// One sweep of N points in the sensor's frame.
#[derive(Debug, Clone, PartialEq)]
pub struct StreetSweep {
    /// Index of the sweep in the street, from 0.
    pub index: usize,
    /// N points, metres, sensor frame of their own time: x forward, y left, z up, the ground near
    /// z = -1.73.
    pub points: Vec<Point>,
    /// N times of the points in a rolling sweep, seconds after the sweep's time. None for a sweep
    /// that is taken at one instant.
    pub times: Option<Vec<f32>>,
    /// N object indices; -1 for the ground and the static world. Moving objects come first, parked
    /// cars after them. An object keeps its index in all sweeps.
    pub object: Vec<i32>,
    /// N flags: true for ground points.
    pub ground: Vec<bool>,
    /// Pose of the sensor at the sweep's time: the transform from its frame to the world's,
    /// translation in metres. The world has z up.
    pub world_from_sensor: RigidTransform,
}

/// Two consecutive sweeps of N and M points, and their ground truth. All lists have one row per
/// source point, except `target` and `ground_target`, which have one per target point.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedPair {
    /// N points of the first sweep, metres, in its sensor frame.
    pub source: Vec<Point>,
    /// M points of the second sweep, metres, in its own sensor frame.
    pub target: Vec<Point>,
    /// N and M times of the points, as in [`StreetSweep::times`].
    pub times: Option<[Vec<f32>; 2]>,
    /// True flow, N x 3 metres per sweep interval, ego motion included.
    pub flow: Vec<Point>,
    /// N flags: true for points that move 0.05 m or more per sweep interval relative to the static
    /// world.
    pub dynamic: Vec<bool>,
    /// N flags: true for points on cars, cyclists and pedestrians, parked or moving.
    pub foreground: Vec<bool>,
    /// N object indices, one for each source point, as in [`StreetSweep::object`].
    pub object: Vec<i32>,
    /// N flags: true for source points on the ground.
    pub ground_source: Vec<bool>,
    /// M flags: true for target points on the ground.
    pub ground_target: Vec<bool>,
    /// Ego motion, translation in metres. It maps a static source point into the target's frame.
    pub target_from_source: RigidTransform,
}

impl Street {
    /// Builds the street. Its sweeps are computed on demand.
    ///
    /// # Errors
    /// - [`StreetError::OutOfRange`] if an option is not a number or out of its range. The yaw rate
    ///   is out of range if the curve radius is below 40 m.
    /// - [`StreetError::TooManyRays`] if a sweep has more than 1,048,576 rays.
    pub fn new(options: &StreetOptions) -> Result<Self, StreetError> {
        options.validate()?;
        let mut random = Random::new(options.seed);
        let drawn_speed = random.uniform(5.0, 11.0);
        let drawn_curvature = random.uniform(-0.004, 0.004);
        let speed = options.speed_mps.unwrap_or(drawn_speed);
        let yaw_rate = options.yaw_rate_rps.unwrap_or(drawn_curvature * speed);
        let curvature = StreetOptions::curvature(yaw_rate, speed)?;

        let terrain = Terrain::new(curvature, &mut random);
        let travel = speed * SWEEP_SECONDS * options.sweeps as f64;
        // Random numbers of its own: a street is the same with and without it.
        let springs = || Suspension::new(&mut Random::new(options.seed ^ SPRINGS));
        Ok(Self {
            sweeps: options.sweeps,
            speed,
            rolling: options.rolling,
            suspension: options.suspension.then(springs),
            world: World::new(&terrain, travel, &mut random),
            movers: traffic(options.movers, speed, &terrain, &mut random),
            lidar: Lidar::new(options, &mut random),
            terrain,
        })
    }

    /// Number of sweeps.
    pub fn sweeps(&self) -> usize {
        self.sweeps
    }

    /// Type of the object with an index as in [`StreetSweep::object`]; none for -1, and for indices
    /// without an object.
    pub fn kind(&self, object: i32) -> Option<Kind> {
        self.object(object).map(|object| object.kind)
    }

    /// The true tracks of the moving objects in `sweeps` of this street. The identity of an object
    /// is its index plus 1. Each has a state in every sweep, with the box around the whole object,
    /// its mean velocity until the next sweep, and its number of points off the ground; zero where
    /// it is hidden.
    pub fn tracks(&self, sweeps: &[StreetSweep]) -> Vec<Track> {
        let shown = sweeps.iter().map(|sweep| {
            let mut points = vec![0; self.movers.len()];
            for (&object, ground) in sweep.object.iter().zip(&sweep.ground) {
                let mover = usize::try_from(object).ok();
                if let Some(points) = mover.and_then(|mover| points.get_mut(mover))
                    && !ground
                {
                    *points += 1;
                }
            }
            points
        });
        let shown: Vec<Vec<u32>> = shown.collect();
        let track = |(mover, object): (usize, &Object)| {
            let states = sweeps.iter().zip(&shown);
            let states = states.map(|(sweep, shown)| self.state(object, sweep, shown[mover]));
            Track {
                id: mover as u32 + 1,
                states: states.collect(),
            }
        };
        self.movers.iter().enumerate().map(track).collect()
    }

    /// State of an object with `points` points in a sweep.
    fn state(&self, object: &Object, sweep: &StreetSweep, points: u32) -> TrackState {
        let [low, high] = object.extent();
        let center = Point3::from([0, 1, 2].map(|a| low[a].midpoint(high[a])));
        let sensor_from_world = sweep.world_from_sensor.inverse();
        let [now, next] = [sweep.index, sweep.index + 1]
            .map(|index| sensor_from_world * object.pose(&self.terrain, seconds(index as f64)));
        let ahead = now.rotation * Vector3::x();
        let velocity = (next * center - now * center) / SWEEP_SECONDS;
        let turn = (next.rotation * now.rotation.inverse()).scaled_axis().z;
        TrackState {
            sweep: sweep.index as u32,
            bounds: OrientedBox {
                center: (now * center).coords.map(|c| c as f32).into(),
                size: core::array::from_fn(|a| (high[a] - low[a]) as f32),
                yaw: ahead.y.atan2(ahead.x) as f32,
            },
            velocity: velocity.map(|c| c as f32).into(),
            yaw_rate: (turn / SWEEP_SECONDS) as f32,
            points,
            confidence: 1.0,
        }
    }

    /// Computes the sweep with this index, from 0. The result is bit-identical for any order of
    /// calls and number of threads.
    ///
    /// # Errors
    /// [`StreetError::NoSuchSweep`] if the street has no sweep with this index.
    pub fn sweep(&self, index: usize) -> Result<StreetSweep, StreetError> {
        self.check_sweep(index)?;
        let instants = if self.rolling { INSTANTS } else { 1 };
        let share = |instant: usize| instant as f64 / instants as f64;
        let views = (0..instants).map(|instant| {
            let at = index as f64 + share(instant);
            let world_from_sensor = self.pose(at);
            View {
                targets: self.targets(at, &world_from_sensor),
                world_from_sensor,
            }
        });
        let views: Vec<View> = views.collect();
        let seen = self.lidar.sweep(index, &self.terrain, &views);
        let times = seen.iter().enumerate().flat_map(|(instant, returns)| {
            let time = seconds(share(instant)) as f32;
            returns.iter().map(move |_| time)
        });
        let times = self.rolling.then(|| times.collect());
        let returns = seen.concat();
        Ok(StreetSweep {
            index,
            points: returns.iter().map(|hit| hit.point).collect(),
            times,
            object: returns.iter().map(|hit| hit.object).collect(),
            ground: returns.iter().map(|hit| hit.is_ground).collect(),
            world_from_sensor: self.pose(index as f64),
        })
    }

    /// True depth image at the time of a sweep, without noise and loss. The camera is mounted at
    /// [`Camera::camera_from_lidar`] relative to the lidar. Pixels without a surface within 120 m
    /// have the depth 0, which means unknown.
    ///
    /// # Errors
    /// [`StreetError::NoSuchSweep`] if the street has no sweep with this index.
    pub fn depth(&self, index: usize, camera: &Camera) -> Result<DepthImage, StreetError> {
        self.check_sweep(index)?;
        let world_from_camera = self.pose(index as f64) * camera.camera_from_lidar().inverse();
        let targets = self.targets(index as f64, &world_from_camera);
        Ok(view::depth(
            camera,
            &self.terrain,
            &world_from_camera,
            &targets,
        ))
    }

    /// True flow of the points of the sweep with this index to the time of the next one, N x 3
    /// metres: the later position in the later sensor frame, minus the position in the sweep. The
    /// last sweep has a flow as well.
    ///
    /// # Errors
    /// [`StreetError::NoSuchSweep`] if the street has no sweep with this index.
    pub fn flow(&self, index: usize) -> Result<Vec<Point>, StreetError> {
        Ok(self.flow_to(&self.sweep(index)?, (index + 1) as f64))
    }

    /// The sweeps `index` and `index + 1`, and their ground truth.
    ///
    /// # Errors
    /// [`StreetError::NoSuchSweep`] if the street lacks one of the two sweeps.
    pub fn pair(&self, index: usize) -> Result<SimulatedPair, StreetError> {
        let source = self.sweep(index)?;
        let target = self.sweep(index + 1)?;
        let target_from_source = target.world_from_sensor.inv_mul(&source.world_from_sensor);
        let deskewed = self.deskewed(&source);
        let flow = self.flow_from(&source, &deskewed, (index + 1) as f64);
        let dynamic = flow.iter().zip(deskewed).map(|(flow, point)| {
            let rigid = motion(&target_from_source, point);
            let residual = Vector3::from(flow.map(f64::from)) - rigid;
            residual.norm() >= DYNAMIC_M
        });
        Ok(SimulatedPair {
            dynamic: dynamic.collect(),
            flow,
            foreground: source.object.iter().map(|&object| object >= 0).collect(),
            source: source.points,
            target: target.points,
            times: source.times.zip(target.times).map(<[_; 2]>::from),
            object: source.object,
            ground_source: source.ground,
            ground_target: target.ground,
            target_from_source,
        })
    }

    fn check_sweep(&self, frame: usize) -> Result<(), StreetError> {
        let sweeps = self.sweeps;
        if frame < sweeps {
            Ok(())
        } else {
            Err(StreetError::NoSuchSweep {
                index: frame,
                sweeps,
            })
        }
    }

    /// True flow of the points of `frame`, a sweep of this street, to the time `at`. The time is in
    /// sweep intervals since the first sweep. It may lie between sweeps, before `frame` or after
    /// the last sweep, and must be finite. The computing time grows with the distance driven until
    /// then.
    ///
    /// The result is N x 3 metres: the position at that time in the sensor frame of that time,
    /// minus the position in the sweep. A point of a rolling sweep starts from its deskewed
    /// position, see [`Street::deskewed`], and an object moves for as long after the point's own
    /// time.
    pub fn flow_to(&self, frame: &StreetSweep, at: f64) -> Vec<Point> {
        self.flow_from(frame, &self.deskewed(frame), at)
    }

    fn flow_from(&self, frame: &StreetSweep, deskewed: &[Point], at: f64) -> Vec<Point> {
        let now = frame.world_from_sensor;
        let next_from_world = self.pose(at).inverse();
        let way = seconds(at - frame.index as f64);
        let runs = instants(frame);
        let flows = runs.flat_map(|(rows, time)| {
            let began = seconds(frame.index as f64) + f64::from(time);
            let moving: Vec<RigidTransform> = self
                .movers
                .iter()
                .map(|object| {
                    let moved = object.pose(&self.terrain, began + way)
                        * object.pose(&self.terrain, began).inverse();
                    next_from_world * moved * now
                })
                .collect();
            rows.map(move |row| {
                let mover = usize::try_from(frame.object[row]).ok();
                let mover = mover.and_then(|index| moving.get(index));
                let still = next_from_world * now;
                let moved = motion(mover.unwrap_or(&still), deskewed[row]);
                moved.map(|component| component as f32).into()
            })
        });
        flows.collect()
    }

    /// The points of a sweep of this street in the sensor's frame of the sweep's time, N x 3
    /// metres: where the surfaces that they were measured on were when they were measured. Those of
    /// a sweep that is taken at one instant are its points.
    pub fn deskewed(&self, frame: &StreetSweep) -> Vec<Point> {
        let sensor_from_world = frame.world_from_sensor.inverse();
        let points = instants(frame).flat_map(|(rows, time)| {
            let at = frame.index as f64 + f64::from(time) / SWEEP_SECONDS;
            let then = sensor_from_world * self.pose(at);
            rows.map(move |row| {
                if time == 0.0 {
                    return frame.points[row];
                }
                transform_point(&then, frame.points[row])
            })
        });
        points.collect()
    }

    /// Pose of the sensor, `world_from_sensor` with the translation in metres, at a time in sweep
    /// intervals since the first sweep. The time must be finite, and may be negative or after the
    /// last sweep. The computing time grows with the distance driven until then.
    pub fn pose(&self, at: f64) -> RigidTransform {
        let x = self.terrain.advance(0.0, self.speed * seconds(at));
        let position = self.terrain.position(x, -LANE_M);
        let world_from_ego = self
            .terrain
            .seat(position, self.terrain.heading(x), EGO_STAND_M);
        let ego_from_body = self
            .suspension
            .as_ref()
            .map(|springs| springs.body(seconds(at)));
        let world_from_body = world_from_ego * ego_from_body.unwrap_or_default();
        world_from_body * Translation3::new(0.0, 0.0, SENSOR_HEIGHT_M)
    }

    fn object(&self, object: i32) -> Option<&Object> {
        let index = usize::try_from(object).ok()?;
        self.movers.iter().chain(&self.world.parked).nth(index)
    }

    /// All solids of the street at a time, in sweep intervals, in the sensor's frame.
    fn targets(&self, at: f64, world_from_sensor: &RigidTransform) -> Vec<Target> {
        let sensor_from_world = world_from_sensor.inverse();
        let still = self.world.solids.iter().map(|solid| Target {
            shape: solid.shape,
            sensor_from_solid: sensor_from_world * solid.world_from_solid,
            object: -1,
        });
        let objects = self.movers.iter().chain(&self.world.parked).zip(0..);
        let parts = objects.flat_map(|(object, number)| {
            let pose = sensor_from_world * object.pose(&self.terrain, seconds(at));
            object.parts.iter().map(move |&(shape, center)| Target {
                shape,
                sensor_from_solid: pose * Translation3::from(center),
                object: number,
            })
        });
        still.chain(parts).collect()
    }
}

/// The rows of a sweep that were measured at one time, and the time, seconds after the sweep's.
fn instants(frame: &StreetSweep) -> impl Iterator<Item = (Range<usize>, f32)> {
    let runs: Vec<(usize, f32)> = match &frame.times {
        None => vec![(frame.points.len(), 0.0)],
        Some(times) => {
            let runs = times.chunk_by(|a, b| a == b);
            runs.map(|run| (run.len(), run[0])).collect()
        }
    };
    let mut first = 0;
    runs.into_iter().map(move |(count, time)| {
        let rows = first..first + count;
        first = rows.end;
        (rows, time)
    })
}

/// Converts a time in sweep intervals to seconds.
fn seconds(at: f64) -> f64 {
    at * SWEEP_SECONDS
}

/// Displacement of a point by a transform, metres.
fn motion(transform: &RigidTransform, point: Point) -> Vector3<f64> {
    let point = Point3::from(point.map(f64::from));
    transform * point - point
}

#[cfg(test)]
mod tests;
