//! Registration of simulated streets, and of scenes that determine the motion partly or not at all.

use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::{Isometry3, Point3, Vector3};

use super::align::{SurfelCloud, align};
use super::posterior::Prior;
use crate::flow::data::{Control, Interrupt, Point, Random, RigidTransform, Uncontrolled};
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};

/// Accuracy that is required on real pairs.
const ACCURACY_M: f64 = 0.02;
const ACCURACY_DEG: f64 = 0.1;

fn aligned(
    source: &[Point],
    target: &[Point],
    prior: &RigidTransform,
    control: &dyn Control,
) -> RigidTransform {
    align(
        &SurfelCloud::new(source),
        &SurfelCloud::new(target),
        prior,
        control,
    )
    .motion
}

fn found(source: &[Point], target: &[Point]) -> RigidTransform {
    aligned(source, target, &RigidTransform::identity(), &Uncontrolled)
}

fn street(seed: u64, speed_mps: Option<f64>, yaw_rate_rps: Option<f64>) -> SimulatedPair {
    let options = StreetOptions {
        seed,
        azimuth_steps: 1000,
        speed_mps,
        yaw_rate_rps,
        ..StreetOptions::default()
    };
    Street::new(&options).unwrap().pair(0).unwrap()
}

fn moved(points: &[Point], motion: &RigidTransform) -> Vec<Point> {
    let moved = points
        .iter()
        .map(|p| motion * Point3::from(p.map(f64::from)));
    moved.map(|p| p.map(|c| c as f32).into()).collect()
}

fn yaw(translation_m: [f64; 3], degrees: f64) -> RigidTransform {
    let rotation = Vector3::new(0.0, 0.0, degrees.to_radians());
    Isometry3::new(Vector3::from(translation_m), rotation)
}

/// Distance in metres and angle in degrees between two motions.
fn gap(a: &RigidTransform, b: &RigidTransform) -> (f64, f64) {
    let gap = a.inv_mul(b);
    (
        gap.translation.vector.norm(),
        gap.rotation.angle().to_degrees(),
    )
}

fn assert_near(found: &RigidTransform, truth: &RigidTransform, what: &str) {
    let (meters, degrees) = gap(found, truth);
    assert!(
        meters < ACCURACY_M && degrees < ACCURACY_DEG,
        "{what}: {meters} m, {degrees} degrees"
    );
}

/// Random points on a rectangle with a corner at `corner` and the sides `along` and `across`, with
/// noise of 0.01 m along the normal.
fn rectangle(
    random: &mut Random,
    points: usize,
    [corner, along, across]: [Vector3<f64>; 3],
) -> Vec<Point> {
    let normal = along.cross(&across).normalize();
    let mut point = || {
        let [a, b] = [0; 2].map(|_| random.uniform(0.0, 1.0));
        let point = corner + along * a + across * b + normal * (random.normal() * 0.01);
        [point.x as f32, point.y as f32, point.z as f32]
    };
    (0..points).map(|_| point()).collect()
}

#[test]
fn drives_and_turns_of_streets_with_movers_are_found_from_rest() {
    for seed in 0..3 {
        for (speed, rate) in [(0.0, 0.0), (10.0, 0.2), (30.0, -0.7)] {
            let pair = street(seed, Some(speed), Some(rate));
            let truth = &pair.target_from_source;
            let what = format!("seed {seed}, {speed} m/s, {rate} rad/s");
            assert_near(&found(&pair.source, &pair.target), truth, &what);
            assert_near(&found(&pair.target, &pair.source), &truth.inverse(), &what);
        }
    }
}

#[test]
fn the_truth_lies_within_two_deviations_and_they_grow_without_ground() {
    let [mut within, mut all] = [0; 2];
    for seed in 20..26 {
        let options = StreetOptions {
            seed,
            suspension: true,
            ..StreetOptions::default()
        };
        let pair = Street::new(&options).unwrap().pair(0).unwrap();
        let off = |points: &[Point], ground: &[bool]| -> Vec<Point> {
            let rows = points.iter().zip(ground).filter(|(_, ground)| !**ground);
            rows.map(|(&point, _)| point).collect()
        };
        let without = [
            off(&pair.source, &pair.ground_source),
            off(&pair.target, &pair.ground_target),
        ];
        let clouds = [[pair.source, pair.target], without];
        let deviations = clouds.map(|[source, target]| {
            let [source, target] = [source, target].map(|points| SurfelCloud::new(&points));
            let rest = RigidTransform::identity();
            let found = align(&source, &target, &rest, &Uncontrolled);
            let covariance = found.covariance.expect("a covariance");
            assert_eq!(covariance, covariance.transpose());
            let truth = Prior::of_vehicle(&pair.target_from_source);
            for (a, error) in truth.deviation(&found.motion).iter().enumerate() {
                within += usize::from(error.abs() < 2.0 * covariance[(a, a)].sqrt());
                all += 1;
            }
            [2, 3, 4].map(|a| covariance[(a, a)].sqrt())
        });
        let [with, without] = deviations;
        assert!(
            without[0] > 3.0 * with[0] && without[1] > 3.0 * with[1],
            "{deviations:?}"
        );
    }
    assert!(10 * within >= 9 * all, "{within} of {all}");
}

#[test]
fn five_metres_and_eight_degrees_are_found_from_rest_and_more_from_a_prior() {
    let pair = street(1, None, None);
    for truth in [
        yaw([3.0, 0.0, 0.0], 5.0),
        yaw([-3.0, 0.1, 0.02], -5.0),
        yaw([5.0, 0.5, 0.1], 8.0),
        yaw([3.0, 0.3, 0.06], -12.0),
    ] {
        let source = moved(&pair.source, &(truth.inverse() * pair.target_from_source));
        assert_near(&found(&source, &pair.target), &truth, "from rest");
    }
    let truth = yaw([12.0, 7.0, 0.5], 60.0);
    let prior = yaw([10.0, 7.0, 0.5], 57.0);
    let source = moved(&pair.source, &(truth.inverse() * pair.target_from_source));
    let found = aligned(&source, &pair.target, &prior, &Uncontrolled);
    assert_near(&found, &truth, "from a prior");
}

#[test]
fn ten_metres_are_found_whichever_axis_of_the_sensor_is_forward() {
    let pair = street(1, None, None);
    let drive = yaw([10.0, 0.5, 0.1], 3.0);
    for turn in [yaw([0.0; 3], 0.0), yaw([0.0; 3], 90.0)] {
        let truth = turn * drive * turn.inverse();
        let aligned = moved(&pair.source, &(turn * pair.target_from_source));
        let source = moved(&aligned, &truth.inverse());
        let target = moved(&pair.target, &turn);
        assert_near(&found(&source, &target), &truth, "from rest");
    }
}

#[test]
fn identical_clouds_do_not_move() {
    let target = street(5, None, None).target;
    let (meters, degrees) = gap(&found(&target, &target), &RigidTransform::identity());
    assert!(
        meters < 1e-6 && degrees < 1e-6,
        "{meters} m, {degrees} degrees"
    );
}

#[test]
fn what_a_scene_leaves_free_stays_as_in_the_prior() {
    let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
    let mut random = Random::new(3);
    let mut tunnel = |moved_m: f64| -> Vec<Point> {
        let [x, y, z] = axes;
        let first = x * -40.0;
        let walls = [
            [first - y * 4.0, x * 80.0, y * 8.0],
            [first - y * 4.0, x * 80.0, z * 5.0],
            [first + y * 4.0, x * 80.0, z * 5.0],
            [first - y * 4.0 + z * 5.0, x * 80.0, y * 8.0],
        ];
        let walls = walls.map(|[corner, a, b]| [corner - y * moved_m, a, b]);
        let walls = walls.map(|wall| rectangle(&mut random, 8000, wall));
        walls.concat()
    };
    let (source, target) = (tunnel(0.0), tunnel(0.4));
    for along in [0.0, 1.3] {
        let prior = yaw([along, 0.0, 0.0], 0.0);
        let [source, target] = [&source, &target].map(|points| SurfelCloud::new(points));
        let found = align(&source, &target, &prior, &Uncontrolled);
        assert_near(&found.motion, &yaw([along, -0.4, 0.0], 0.0), "a tunnel");
        let covariance = found.covariance.expect("a covariance");
        let deviation = |a: usize| covariance[(a, a)].sqrt();
        assert!(deviation(0) > 1.0 && deviation(1) < 0.01, "{covariance}");
    }
    let [x, y, z] = axes;
    let mut plain = |z_m: f64| {
        rectangle(
            &mut random,
            20_000,
            [z * z_m - (x + y) * 20.0, x * 40.0, y * 40.0],
        )
    };
    let (source, target) = (plain(-1.5), plain(-1.4));
    assert_near(
        &found(&source, &target),
        &yaw([0.0, 0.0, 0.1], 0.0),
        "a plain",
    );
}

#[test]
fn degenerate_scenes_give_a_finite_motion() {
    let mut random = Random::new(1);
    let mut plane = |z: f32| -> Vec<Point> {
        let mut side = || random.uniform(-10.0, 10.0) as f32;
        (0..500).map(|_| [side(), side(), z]).collect()
    };
    let scenes = [
        (plane(0.0), plane(0.3)),
        (vec![[1.0, 2.0, 3.0]; 100], vec![[1.0, 2.0, 3.0]; 100]),
        (vec![[1.0, 2.0, 3.0]; 100], vec![[1.5, 2.0, 2.0]; 100]),
        (plane(0.0), vec![[100.0, 50.0, 0.0]]),
        (vec![], vec![[1.0; 3]]),
        (vec![[f32::NAN; 3], [0.0; 3]], vec![[1.0; 3]]),
        (vec![[1e9; 3]; 9], vec![[1e30; 3]; 9]),
    ];
    for (source, target) in scenes {
        let found = found(&source, &target);
        assert!(
            found.to_homogeneous().iter().all(|value| value.is_finite()),
            "{found}"
        );
    }
}

#[test]
fn clouds_that_have_nothing_in_common_keep_the_prior() {
    let here = street(2, None, None).source;
    let far = moved(&here, &yaw([500.0, 0.0, 0.0], 0.0));
    let prior = yaw([1.0, 2.0, 0.0], 3.0);
    assert_eq!(aligned(&here, &far, &prior, &Uncontrolled), prior);
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let pair = street(4, None, None);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = pool.expect("threads");
        pool.install(|| found(&pair.source, &pair.target))
    };
    let one = on(1);
    assert_eq!(one, on(2));
    assert_eq!(one, on(5));
}

#[test]
fn an_interrupt_at_any_moment_gives_a_finite_motion() {
    /// Interrupts from a given number of checks on.
    struct After(usize, AtomicUsize);
    impl Control for After {
        fn interrupt(&self) -> Option<Interrupt> {
            (self.1.fetch_add(1, Ordering::Relaxed) >= self.0).then_some(Interrupt::Deadline)
        }
    }
    let pair = street(6, Some(10.0), Some(0.0));
    let prior = RigidTransform::identity();
    for looks in [0, 1, 40, 110, 120] {
        let control = After(looks, AtomicUsize::new(0));
        let found = aligned(&pair.source, &pair.target, &prior, &control);
        assert!(gap(&found, &pair.target_from_source).0 < 20.0, "{looks}");
    }
}
