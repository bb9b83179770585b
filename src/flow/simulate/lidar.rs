//! Model of a spinning lidar: one ray per laser and azimuth step, with range noise and dropout.
//!
//! A sweep consists of one or more views, each of a range of columns at one instant. Columns run in
//! parallel, each with its own random stream, so the sweep does not depend on the number of threads.

use std::f64::consts::{PI, TAU};

use nalgebra::Vector3;
use rayon::prelude::*;

use super::options::StreetOptions;
use super::scene::{FARTHEST_M, Scene, Target};
use super::shapes::Hit;
use super::terrain::Terrain;
use crate::flow::data::{Point, Random, RigidTransform};

/// Minimum and maximum range, metres. Returns outside are dropped.
const RANGES_M: [f64; 2] = [1.0, FARTHEST_M];
/// Elevations of the top laser, of the middle of the fan, and of the bottom laser, degrees. With 64
/// lasers the spacing is one third of a degree above the middle and half a degree below, as in the
/// HDL-64E.
const ELEVATIONS_DEG: [f64; 3] = [2.0, -8.5, -24.8];

/// One return of a sweep.
#[derive(Debug, Clone, Copy)]
pub(super) struct Return {
    pub(super) point: Point,
    pub(super) object: i32,
    pub(super) is_ground: bool,
}

/// What a lidar sees at one instant.
#[derive(Debug, Clone)]
pub(super) struct View {
    pub(super) world_from_sensor: RigidTransform,
    /// Solids in the sensor's frame.
    pub(super) targets: Vec<Target>,
}

/// A lidar with its lasers.
#[derive(Debug, Clone)]
pub(super) struct Lidar {
    seed: u64,
    azimuth_steps: usize,
    range_noise: f64,
    dropout: f64,
    /// Sine and cosine of the elevation, and the constant range error in metres, of each laser.
    lasers: Vec<([f64; 2], f64)>,
}

impl Lidar {
    /// A lidar whose constant range errors are drawn once.
    pub(super) fn new(options: &StreetOptions, random: &mut Random) -> Self {
        let laser = |index: usize| {
            let share = index as f64 / (options.beams - 1).max(1) as f64;
            let [top, middle, bottom] = ELEVATIONS_DEG;
            let degrees = if share <= 0.5 {
                top + (middle - top) * share * 2.0
            } else {
                middle + (bottom - middle) * (share * 2.0 - 1.0)
            };
            let (sin, cos) = degrees.to_radians().sin_cos();
            ([sin, cos], options.beam_bias_m * random.normal())
        };
        Self {
            seed: options.seed,
            azimuth_steps: options.azimuth_steps,
            range_noise: options.range_noise_m,
            dropout: options.dropout,
            lasers: (0..options.beams).map(laser).collect(),
        }
    }

    /// The returns of a sweep, one list for each of `views`: column by column, each from the top
    /// laser to the bottom one, in the sensor's frame at the instant of the view. The views share
    /// the columns of a turn evenly, in order.
    pub(super) fn sweep(
        &self,
        frame: usize,
        terrain: &Terrain,
        views: &[View],
    ) -> Vec<Vec<Return>> {
        let stream =
            |column: usize| Random::stream(self.seed, (frame as u64) << 32 | column as u64);
        let step = TAU / self.azimuth_steps as f64;
        // The azimuths of a real sensor differ from turn to turn.
        let phase = stream(self.azimuth_steps).uniform(0.0, step);
        let first = |view: usize| view * self.azimuth_steps / views.len();
        let see = |(index, view): (usize, &View)| {
            let scene = self.prepare(terrain, &view.world_from_sensor, &view.targets, phase);
            let columns: Vec<Vec<Return>> = (first(index)..first(index + 1))
                .into_par_iter()
                .map(|column| {
                    let azimuth = phase + column as f64 * step - PI;
                    self.shoot(&scene, column, azimuth, &mut stream(column))
                })
                .collect();
            columns.concat()
        };
        views
            .par_iter()
            .enumerate()
            .map(|(index, view)| see((index, view)))
            .collect()
    }

    fn shoot(
        &self,
        scene: &Scene,
        column: usize,
        azimuth: f64,
        random: &mut Random,
    ) -> Vec<Return> {
        let (sin, cos) = azimuth.sin_cos();
        let mut returns = Vec::with_capacity(self.lasers.len());
        for &([up, level], bias) in &self.lasers {
            let direction = Vector3::new(cos * level, sin * level, up);
            let Some((hit, object)) = scene.first_hit(column, &direction) else {
                continue;
            };
            let lost = self.dropout * loss(hit);
            let noise = self.range_noise * random.normal();
            if random.uniform(0.0, 1.0) < lost {
                continue;
            }
            let range = hit.range + bias + noise;
            if (RANGES_M[0]..=RANGES_M[1]).contains(&range) {
                returns.push(Return {
                    point: (direction * range).map(|value| value as f32).into(),
                    object: object.unwrap_or(-1),
                    is_ground: object.is_none(),
                });
            }
        }
        returns
    }

    /// Lists for each column the targets that its rays can hit.
    fn prepare<'a>(
        &self,
        terrain: &'a Terrain,
        world_from_sensor: &'a RigidTransform,
        targets: &[Target],
        phase: f64,
    ) -> Scene<'a> {
        let step = TAU / self.azimuth_steps as f64;
        let spread = |target: &Target, meet: &mut dyn FnMut(usize)| {
            let center = target.sensor_from_solid.translation.vector;
            let [distance, radius] = [center.xy().norm(), target.shape.bounding_radius()];
            let half = if distance > radius {
                (radius / distance).asin()
            } else {
                PI
            };
            let azimuth = center.y.atan2(center.x) + PI - phase;
            let first = ((azimuth - half) / step).floor() as i64;
            let last = ((azimuth + half) / step).ceil() as i64;
            let count = self.azimuth_steps as i64;
            for column in first..=last.min(first + count - 1) {
                meet(column.rem_euclid(count) as usize);
            }
        };
        Scene::new(
            terrain,
            world_from_sensor,
            targets,
            self.azimuth_steps,
            spread,
        )
    }
}

/// Probability that a return is too weak to be detected. It increases with range and with grazing
/// incidence.
fn loss(hit: Hit) -> f64 {
    let far = hit.range / RANGES_M[1];
    let grazing = (1.0 - hit.cosine).clamp(0.0, 1.0).powi(8);
    (0.02 + 0.3 * far * far + 0.5 * grazing * far.sqrt()).min(0.98)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loss_grows_with_range_and_grazing() {
        let at = |range, cosine| loss(Hit { range, cosine });
        assert!(at(5.0, 1.0) < 0.05);
        assert!(at(100.0, 1.0) > at(20.0, 1.0));
        assert!(at(50.0, 0.03) > at(50.0, 0.8) + 0.1);
        assert!(at(120.0, 0.0) <= 0.98);
    }

    #[test]
    fn lasers_fan_out_from_top_to_bottom() {
        let lidar = Lidar::new(&StreetOptions::default(), &mut Random::new(0));
        let elevation = |index: usize| lidar.lasers[index].0[0].asin().to_degrees();
        assert!((elevation(0) - 2.0).abs() < 1e-9 && (elevation(63) + 24.8).abs() < 1e-9);
        assert!((1..64).all(|index| elevation(index) < elevation(index - 1)));
    }
}
