//! Tests of simulated streets: their truth against geometry, and refusals.

use super::*;
use std::collections::HashMap;

/// Tolerance of single-precision coordinates up to 120 m.
const SINGLE: f64 = 2e-5;

fn small(seed: u64) -> StreetOptions {
    StreetOptions {
        seed,
        beams: 32,
        azimuth_steps: 900,
        ..StreetOptions::default()
    }
}

fn moved(point: Point, flow: Point) -> Vector3<f64> {
    Vector3::from(point.map(f64::from)) + Vector3::from(flow.map(f64::from))
}

/// Distance of a point in a sensor frame to the surface of an object, metres.
fn distance(street: &Street, frame: usize, object: i32, point: Vector3<f64>) -> f64 {
    let body = street.object(object).unwrap();
    let world = street.pose(frame as f64) * Point3::from(point);
    let local = body.pose(&street.terrain, seconds(frame as f64)).inverse() * world;
    let parts = body.parts.iter();
    parts
        .map(|(shape, center)| shape.surface_distance(&(local.coords - center)))
        .fold(f64::INFINITY, f64::min)
}

#[test]
fn a_seed_gives_the_same_bits_with_any_number_of_threads() {
    let pair = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| Street::new(&small(seed)).unwrap().pair(0).unwrap())
    };
    assert_eq!(pair(1, 5), pair(2, 5));
    assert_ne!(pair(1, 5).source, pair(1, 6).source);
}

#[test]
fn a_full_sweep_has_about_a_hundred_thousand_finite_points() {
    for seed in 0..4 {
        let options = StreetOptions {
            seed,
            ..StreetOptions::default()
        };
        let pair = Street::new(&options).unwrap().pair(0).unwrap();
        assert!(
            (80_000..128_000).contains(&pair.source.len()),
            "{}",
            pair.source.len()
        );
        let ground = pair.ground_source.iter().filter(|&&ground| ground).count();
        assert!((0.25..0.75).contains(&(ground as f64 / pair.source.len() as f64)));
        assert!(pair.dynamic.iter().filter(|&&dynamic| dynamic).count() > 300);
        let finite = |points: &[Point]| points.iter().flatten().all(|value| value.is_finite());
        assert!(finite(&pair.source) && finite(&pair.target) && finite(&pair.flow));
    }
}

#[test]
fn static_points_move_with_the_ego_vehicle_alone() {
    let pair = Street::new(&small(1)).unwrap().pair(0).unwrap();
    assert!(pair.target_from_source.translation.vector.norm() > 0.3);
    for (row, &point) in pair.source.iter().enumerate() {
        let rigid = motion(&pair.target_from_source, point);
        let flow = Vector3::from(pair.flow[row].map(f64::from));
        assert_eq!(pair.dynamic[row], (flow - rigid).norm() >= DYNAMIC_M);
        if !pair.dynamic[row] && pair.object[row] < 0 {
            assert!((flow - rigid).norm() < SINGLE);
        }
    }
}

#[test]
fn objects_are_measured_on_their_surface_and_found_there_in_the_next_frame() {
    let options = StreetOptions {
        range_noise_m: 0.0,
        beam_bias_m: 0.0,
        ..small(2)
    };
    let street = Street::new(&options).unwrap();
    let pair = street.pair(0).unwrap();
    let mut checked = 0;
    for row in (0..pair.source.len()).filter(|&row| pair.foreground[row]) {
        let object = pair.object[row];
        let now = Vector3::from(pair.source[row].map(f64::from));
        assert!(distance(&street, 0, object, now) < SINGLE);
        let next = moved(pair.source[row], pair.flow[row]);
        assert!(distance(&street, 1, object, next) < 2.0 * SINGLE);
        checked += usize::from(pair.dynamic[row]);
    }
    assert!(checked > 100, "{checked}");
}

#[test]
fn noisy_points_stay_within_the_noise_of_their_object() {
    let street = Street::new(&small(2)).unwrap();
    let pair = street.pair(0).unwrap();
    for row in (0..pair.source.len()).filter(|&row| pair.foreground[row]) {
        let next = moved(pair.source[row], pair.flow[row]);
        // Six standard deviations of noise and bias together.
        assert!(distance(&street, 1, pair.object[row], next) < 0.14);
    }
}

#[test]
fn flowed_points_land_near_points_of_the_next_frame() {
    let options = StreetOptions {
        seed: 3,
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).unwrap().pair(0).unwrap();
    let cell = |point: Vector3<f64>| point.map(|value| value.floor() as i32).into();
    let mut cells: HashMap<[i32; 3], Vec<Vector3<f64>>> = HashMap::new();
    for &point in &pair.target {
        let point = Vector3::from(point.map(f64::from));
        cells.entry(cell(point)).or_default().push(point);
    }
    let nearest = |point: Vector3<f64>| {
        let [x, y, z]: [i32; 3] = cell(point);
        let around = (0..27).map(|n| [x + n % 3 - 1, y + n / 3 % 3 - 1, z + n / 9 - 1]);
        let near = around.filter_map(|key| cells.get(&key)).flatten();
        near.map(|other| (other - point).norm()).fold(1.0, f64::min)
    };
    let mean = |flow: &dyn Fn(usize) -> Point| {
        let rows: Vec<usize> = (0..pair.source.len())
            .filter(|&row| !pair.ground_source[row] && !pair.dynamic[row])
            .collect();
        let sum = rows
            .iter()
            .map(|&row| nearest(moved(pair.source[row], flow(row))));
        sum.sum::<f64>() / rows.len() as f64
    };
    let [still, flowed] = [mean(&|_| [0.0; 3]), mean(&|row| pair.flow[row])];
    // Real pairs have 0.07 to 0.10 m. The remaining distance is due to resampling and
    // occlusion.
    assert!(flowed < 0.13 && flowed < 0.7 * still, "{still} {flowed}");
}

#[test]
fn a_street_without_movers_or_speed_stands_still() {
    let options = StreetOptions {
        movers: 0,
        speed_mps: Some(0.0),
        ..small(4)
    };
    let street = Street::new(&options).unwrap();
    let pair = street.pair(0).unwrap();
    assert!(
        pair.flow
            .iter()
            .flatten()
            .all(|value| value.abs() < SINGLE as f32)
    );
    assert!(!pair.dynamic.contains(&true));
    assert_ne!(pair.source, pair.target);
    assert_eq!(street.kind(0), Some(Kind::Car));
    assert_eq!((street.kind(-1), street.kind(i32::MAX)), (None, None));
}

#[test]
fn speed_and_yaw_rate_are_those_asked_for() {
    let options = StreetOptions {
        speed_mps: Some(10.0),
        yaw_rate_rps: Some(0.1),
        ..small(5)
    };
    let street = Street::new(&options).unwrap();
    let step = street.pose(0.0).inv_mul(&street.pose(1.0));
    let (_, _, yaw) = step.rotation.euler_angles();
    // The waves of the ground and the winding of the street change both slightly.
    assert!((yaw - 0.01).abs() < 2e-3, "{yaw}");
    assert!((step.translation.vector.norm() - 1.0).abs() < 0.03);
    let last = street.flow(1).unwrap();
    assert_eq!(last.len(), street.sweep(1).unwrap().points.len());
}

#[test]
fn the_last_frame_of_the_longest_fastest_street_is_sane() {
    let options = StreetOptions {
        sweeps: 1000,
        beams: 1,
        azimuth_steps: 200,
        movers: 256,
        speed_mps: Some(40.0),
        yaw_rate_rps: Some(-1.0),
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).unwrap().pair(998).unwrap();
    assert!(pair.source.len() > 50);
    let far = |point: &Point| !point.iter().all(|value| value.abs() < 121.0);
    assert!(!pair.source.iter().chain(&pair.target).any(far));
    assert!(pair.flow.iter().flatten().all(|value| value.abs() < 20.0));
}

#[test]
fn frames_past_the_end_and_bad_options_are_refused() {
    let street = Street::new(&small(0)).unwrap();
    assert_eq!(street.sweeps(), 2);
    assert!(street.sweep(2).is_err() && street.flow(2).is_err());
    let error = street.pair(1).unwrap_err();
    assert_eq!(error.to_string(), "sweep 2 of a street of 2 sweeps");
    let tight = StreetOptions {
        yaw_rate_rps: Some(0.9),
        ..small(0)
    };
    assert!(Street::new(&tight).is_err());
}

#[test]
fn a_rolling_sweep_measures_each_column_at_a_time_of_its_own() {
    /// Range noise, and the error of a laser, over which a return may miss its surface.
    const NOISE_M: f64 = 0.12;
    let options = StreetOptions {
        rolling: true,
        speed_mps: Some(20.0),
        ..small(4)
    };
    let street = Street::new(&options).unwrap();
    let sweep = street.sweep(1).unwrap();
    let times = sweep.times.as_ref().unwrap();
    assert_eq!((times[0], times.is_sorted()), (0.0, true));
    assert!((0.098..0.1).contains(&f64::from(times[times.len() - 1])));
    let movers = (0..times.len()).filter(|&row| (0..24).contains(&sweep.object[row]));
    let movers: Vec<usize> = movers.collect();
    assert!(movers.len() > 300);
    for row in movers {
        let at = 1.0 + f64::from(times[row]) / SWEEP_SECONDS;
        let object = street.object(sweep.object[row]).unwrap();
        let world = street.pose(at) * Point3::from(sweep.points[row].map(f64::from));
        let local = object.pose(&street.terrain, seconds(at)).inverse() * world;
        let parts = object.parts.iter();
        let off = parts.map(|(shape, center)| shape.surface_distance(&(local.coords - center)));
        let off = off.fold(f64::INFINITY, f64::min);
        assert!(off < NOISE_M, "{off}");
    }
}

#[test]
fn the_flow_of_a_rolling_sweep_starts_from_its_deskewed_points() {
    let options = StreetOptions {
        rolling: true,
        ..small(4)
    };
    let street = Street::new(&options).unwrap();
    let pair = street.pair(0).unwrap();
    let sweep = street.sweep(0).unwrap();
    let deskewed = street.deskewed(&sweep);
    let last = deskewed.len() - 1;
    assert_eq!(deskewed[0], sweep.points[0]);
    let moved = moved(deskewed[last], sweep.points[last].map(|c| -c)).norm();
    assert!((0.4..1.2).contains(&moved), "{moved}");
    for (row, &point) in deskewed.iter().enumerate() {
        if !pair.dynamic[row] && pair.object[row] < 0 {
            let rigid = motion(&pair.target_from_source, point);
            let flow = Vector3::from(pair.flow[row].map(f64::from));
            assert!((flow - rigid).norm() < SINGLE);
        }
    }
    assert_eq!(street.flow(0).unwrap(), pair.flow);
}
