//! Tests of the ground segmentation: simulated streets, real sweeps, and both with disturbances.

use fnsf::flow::Point;
use fnsf::flow::ground::{GroundOptions, GroundSegmentation, segment};
use fnsf::flow::simulate::{Street, StreetOptions};
use proptest::prelude::*;

use super::scenes::real_pair;

/// Minimum precision and recall.
const ENOUGH: f64 = 0.95;
/// Range of the evaluated points, metres.
const WITHIN_M: f32 = 35.0;

/// A sweep and its ground labels.
struct ObjectSearch {
    name: String,
    points: Vec<Point>,
    ground: Vec<bool>,
}

impl ObjectSearch {
    fn moved(&self, change: impl Fn(Point) -> Point) -> Self {
        Self {
            name: self.name.clone(),
            points: self.points.iter().map(|&point| change(point)).collect(),
            ground: self.ground.clone(),
        }
    }

    fn kept(&self, keep: impl Fn(usize) -> bool) -> Self {
        let rows: Vec<usize> = (0..self.points.len()).filter(|&row| keep(row)).collect();
        Self {
            name: self.name.clone(),
            points: rows.iter().map(|&row| self.points[row]).collect(),
            ground: rows.iter().map(|&row| self.ground[row]).collect(),
        }
    }

    fn found(&self) -> GroundSegmentation {
        segment(&self.points, &GroundOptions::default())
    }

    /// Precision and recall within `WITHIN_M` of the origin.
    fn score(&self) -> [f64; 2] {
        let found = self.found().ground;
        let near = |row: &usize| self.points[*row][0].hypot(self.points[*row][1]) < WITHIN_M;
        let rows: Vec<usize> = (0..self.points.len()).filter(near).collect();
        let count = |keep: &dyn Fn(usize) -> bool| rows.iter().filter(|&&row| keep(row)).count();
        let both = count(&|row| found[row] && self.ground[row]) as f64;
        [
            both / count(&|row| found[row]) as f64,
            both / count(&|row| self.ground[row]) as f64,
        ]
    }

    fn expect(&self, what: &str) {
        let [precision, recall] = self.score();
        assert!(
            precision >= ENOUGH && recall >= ENOUGH,
            "{}, {what}: precision {precision:.4}, recall {recall:.4}",
            self.name
        );
    }
}

fn street(options: &StreetOptions) -> ObjectSearch {
    let frame = Street::new(options)
        .and_then(|street| street.sweep(0))
        .expect("a street");
    ObjectSearch {
        name: format!("{} beams, seed {}", options.beams, options.seed),
        points: frame.points,
        ground: frame.ground,
    }
}

/// Streets with 16 to 128 beams.
fn streets(seeds: u64) -> impl Iterator<Item = ObjectSearch> {
    (0..seeds).flat_map(|seed| {
        [16, 32, 64, 128].map(|beams| {
            street(&StreetOptions {
                seed,
                beams,
                azimuth_steps: 1000,
                ..StreetOptions::default()
            })
        })
    })
}

/// Both sweeps of the real pairs with ground labels; none without real data.
fn real_sweeps() -> Vec<ObjectSearch> {
    let mut sweeps = Vec::new();
    for name in ["av2_7fab", "kitti_0000", "small_gicp"] {
        let Some(pair) = real_pair(name) else { break };
        let ground = pair.ground.expect("the pair has ground masks");
        let both = [(pair.source, ground.source), (pair.target, ground.target)];
        for (points, ground) in both {
            let name = name.to_owned();
            sweeps.push(ObjectSearch {
                name,
                points,
                ground,
            });
        }
    }
    sweeps
}

fn yawed(degrees: f32) -> impl Fn(Point) -> Point {
    let (sin, cos) = degrees.to_radians().sin_cos();
    move |[x, y, z]| [cos * x - sin * y, sin * x + cos * y, z]
}

fn rolled(degrees: f32) -> impl Fn(Point) -> Point {
    let (sin, cos) = degrees.to_radians().sin_cos();
    move |[x, y, z]| [x, cos * y - sin * z, sin * y + cos * z]
}

fn pitched(degrees: f32) -> impl Fn(Point) -> Point {
    let (sin, cos) = degrees.to_radians().sin_cos();
    move |[x, y, z]| [cos * x + sin * z, y, cos * z - sin * x]
}

#[test]
fn the_ground_of_real_sweeps_is_found_as_labelled() {
    for sweep in real_sweeps() {
        sweep.expect("as it is");
    }
}

#[test]
fn the_ground_of_simulated_streets_is_found_with_16_to_128_beams() {
    for street in streets(6) {
        street.expect("as it is");
    }
}

#[test]
fn turning_tilting_and_shifting_a_sweep_changes_little() {
    for sweep in streets(1).chain(real_sweeps()) {
        for degrees in [17.0, 45.0, 160.0] {
            sweep.moved(yawed(degrees)).expect("turned");
        }
        for degrees in [-2.0, 2.0] {
            sweep.moved(rolled(degrees)).expect("rolled");
            sweep.moved(pitched(degrees)).expect("pitched");
        }
        let slope = |[x, y, z]: Point| [x, y, z + 0.15 * y];
        sweep.moved(slope).expect("on a slope of 15%");
        for height in [-2.0, 2.0] {
            sweep
                .moved(|[x, y, z]| [x, y, z + height])
                .expect("shifted");
        }
    }
}

#[test]
fn every_fourth_point_is_enough() {
    for sweep in streets(2).chain(real_sweeps()) {
        sweep.kept(|row| row % 4 == 0).expect("every fourth point");
    }
}

#[test]
fn ramps_valleys_and_waves_are_followed() {
    for sweep in streets(1).chain(real_sweeps()) {
        let ramp = |slope: f32| move |[x, y, z]: Point| [x, y, z + slope * (x - 10.0).max(0.0)];
        sweep.moved(ramp(0.15)).expect("a ramp up");
        sweep.moved(ramp(-0.15)).expect("a ramp down");
        let bowl = |bend: f32| move |[x, y, z]: Point| [x, y, z + bend * (x * x + y * y)];
        sweep.moved(bowl(0.002)).expect("a valley");
        sweep.moved(bowl(-0.002)).expect("a hilltop");
        let waves = |[x, y, z]: Point| [x, y, z + 0.5 * (x / 8.0).sin()];
        sweep.moved(waves).expect("waves");
    }
}

#[test]
fn a_lidar_with_noise_of_5_cm_finds_the_ground() {
    for beams in [16, 64] {
        let options = StreetOptions {
            beams,
            azimuth_steps: 1000,
            range_noise_m: 0.05,
            ..StreetOptions::default()
        };
        street(&options).expect("noisy");
    }
}

#[test]
fn mirror_images_below_the_ground_are_told_from_it() {
    for mut sweep in streets(1).chain(real_sweeps()) {
        for row in (0..sweep.points.len()).step_by(100) {
            let [x, y, z] = sweep.points[row];
            if sweep.ground[row] {
                let depth = 0.6 + (row % 7) as f32 * 0.5;
                sweep.points.push([1.3 * x, 1.3 * y, z - depth]);
                sweep.ground.push(false);
            }
        }
        sweep.expect("with mirror images");
    }
}

#[test]
fn a_sweep_whose_ground_was_taken_off_has_none() {
    // The mask of kitti_0000 misses 2,000 ground points, so that pair is not used.
    let taken_off = |sweep: ObjectSearch| sweep.kept(|row| !sweep.ground[row]);
    let real = real_sweeps().into_iter().filter(|s| s.name != "kitti_0000");
    for sweep in streets(3).chain(real).map(taken_off) {
        let found = sweep.found();
        assert_eq!(found.origin_height_m, None, "{}", sweep.name);
        assert!(!found.ground.contains(&true), "{}", sweep.name);
    }
}

#[test]
fn the_simulated_lidars_height_is_found_to_2_cm() {
    for street in streets(3) {
        let height = street.found().origin_height_m.expect("there is ground");
        assert!((height - 1.73).abs() < 0.02, "{}: {height}", street.name);
    }
}

#[test]
fn the_same_sweep_gives_the_same_ground() {
    for sweep in streets(1) {
        assert_eq!(sweep.found(), sweep.found());
    }
}

proptest! {
    #[test]
    fn any_finite_points_get_a_flag_each(
        points in prop::collection::vec(prop::array::uniform3(prop::num::f32::NORMAL), 0..200),
        near in prop::collection::vec(prop::array::uniform3(-20.0_f32..20.0), 0..200),
    ) {
        let points = [points, near].concat();
        let found = segment(&points, &GroundOptions::default());
        prop_assert_eq!(found.ground.len(), points.len());
    }
}
