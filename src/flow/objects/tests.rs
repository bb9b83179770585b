//! The object search on constructed scenes and on simulated streets.

use core::convert::Infallible;
use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::Point3;

use super::packed::{FoundInScene, PackedScene};
use super::search::{ObjectSearch, SearchClouds, find_objects};
use crate::flow::data::{Control, Interrupt, Point, Random, RigidTransform, Uncontrolled};
use crate::flow::options::ObjectOptions;
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};

/// Position along y of a wall along x, beside which a car drives, metres.
const WALL_Y_M: f64 = 6.0;

/// Two sides and the roof of a box with a corner at (x, y), sampled at random.
fn car(random: &mut Random, [x, y]: [f64; 2]) -> Vec<Point> {
    let mut point = || {
        let [a, b] = [0; 2].map(|_| random.uniform(0.0, 1.0));
        let [dx, dy, dz] = match random.below(3) {
            0 => [a * 4.0, 0.0, b * 1.5],
            1 => [0.0, a * 1.8, b * 1.5],
            _ => [a * 4.0, b * 1.8, 1.5],
        };
        [(x + dx) as f32, (y + dy) as f32, (dz - 1.2) as f32]
    };
    (0..1500).map(|_| point()).collect()
}

fn wall(random: &mut Random, [from, to]: [f64; 2]) -> Vec<Point> {
    let count = ((to - from) * 150.0) as usize;
    let mut point = || {
        let [x, z] = [random.uniform(from, to), random.uniform(-1.2, 1.5)];
        [x as f32, WALL_Y_M as f32, z as f32]
    };
    (0..count).map(|_| point()).collect()
}

/// Two sweeps from the same position.
fn clouds<'a>(source: &'a [Point], target: &'a [Point]) -> SearchClouds<'a> {
    SearchClouds {
        times: None,
        source,
        target,
        neighbors: &[],
        sweeps: [source, target],
        target_from_source: RigidTransform::identity(),
    }
}

/// The search by the host's threads.
fn searched(clouds: &SearchClouds<'_>, control: &dyn Control) -> ObjectSearch {
    let on_host: Result<_, Infallible> =
        find_objects(clouds, &ObjectOptions::default(), None, control);
    on_host.unwrap_or_else(|never| match never {})
}

fn found(source: &[Point], target: &[Point]) -> ObjectSearch {
    searched(&clouds(source, target), &Uncontrolled)
}

#[test]
fn a_car_moves_and_the_wall_beside_it_stands_still() {
    // Both sweeps sample the car at 1,500 random points of 16 square metres: 0.1 m apart.
    const TOLERANCE_M: f32 = 0.05;
    let mut random = Random::new(1);
    let street = wall(&mut random, [-15.0, 15.0]);
    let source = [car(&mut random, [5.0, 0.0]), street].concat();
    let street = wall(&mut random, [-15.0, 15.0]);
    let target = [car(&mut random, [6.1, 0.1]), street].concat();
    let search = found(&source, &target);
    let residual = search.motions.residual_at(&source);
    assert_eq!(search.residual_of(&source), residual);
    for (residual, point) in residual.iter().zip(&source) {
        if point[1] > 5.0 {
            assert_eq!(*residual, [0.0; 3]);
        } else {
            let off = (residual[0] - 1.1).hypot(residual[1] - 0.1);
            assert!(off < TOLERANCE_M && residual[2] == 0.0, "{residual:?}");
        }
    }
}

#[test]
fn a_wall_whose_hidden_part_shifts_does_not_move() {
    let mut random = Random::new(2);
    let source = wall(&mut random, [2.0, 6.0]);
    let target = wall(&mut random, [3.0, 7.0]);
    let residual = found(&source, &target).motions.residual_at(&source);
    assert!(residual.iter().all(|&residual| residual == [0.0; 3]));
}

/// A wall three times as far as [`wall`], without the part that the section `from..to` of that
/// hides.
fn wall_behind(random: &mut Random, [from, to]: [f64; 2]) -> Vec<Point> {
    let mut points = Vec::new();
    for _ in 0..60_000 {
        let [x, z] = [random.uniform(-30.0, 30.0), random.uniform(-3.0, 4.0)];
        let is_hidden = (from..to).contains(&(x / 3.0)) && (-1.2..1.5).contains(&(z / 3.0));
        if !is_hidden {
            points.push([x as f32, 3.0 * WALL_Y_M as f32, z as f32]);
        }
    }
    points
}

#[test]
fn a_flat_side_moves_that_uncovers_what_is_behind_it() {
    // Only its ends determine the displacement.
    const TOLERANCE_M: f32 = 0.15;
    let mut random = Random::new(2);
    let mut sweep = |part| [wall(&mut random, part), wall_behind(&mut random, part)].concat();
    // A cyclist, and a van.
    for ([from, to], way) in [([2.0, 4.0], 0.6), ([2.0, 6.0], 1.0)] {
        let [source, target] = [sweep([from, to]), sweep([from + way, to + way])];
        let residual = found(&source, &target).motions.residual_at(&source);
        for (residual, point) in residual.iter().zip(&source) {
            let moves = if point[1] < 10.0 { way as f32 } else { 0.0 };
            let off_m = (residual[0] - moves).hypot(residual[1]);
            assert!(off_m < TOLERANCE_M, "{residual:?}, {way}");
        }
    }
}

#[test]
fn a_resampled_scene_stands_still() {
    let mut random = Random::new(3);
    let mut sweep = || {
        [
            wall(&mut random, [-15.0, 15.0]),
            car(&mut random, [5.0, 0.0]),
        ]
        .concat()
    };
    let [source, target] = [sweep(), sweep()];
    let residual = found(&source, &target).motions.residual_at(&source);
    assert!(residual.iter().all(|&residual| residual == [0.0; 3]));
}

#[test]
fn clouds_of_a_few_points_or_all_in_one_place_give_a_finite_motion() {
    let one: Vec<Point> = vec![[1.0, 2.0, 3.0]; 500];
    let far: Vec<Point> = vec![[3e9, -3e9, 1e9]; 9];
    let few: Vec<Point> = vec![[0.0; 3], [1.0; 3], [2.0; 3]];
    for source in [&one, &far, &few] {
        for target in [&one, &far, &few] {
            let residual = found(source, target).motions.residual_at(source);
            assert!(residual.iter().flatten().all(|r| r.is_finite()));
        }
    }
}

fn street(seed: u64) -> SimulatedPair {
    let options = StreetOptions {
        seed,
        beams: 32,
        azimuth_steps: 1000,
        ..StreetOptions::default()
    };
    let street = Street::new(&options);
    street.and_then(|street| street.pair(0)).expect("a street")
}

/// Source and target off the ground, the source with the true ego motion taken out, and the true
/// residual flow.
fn residual_problem(pair: &SimulatedPair) -> [Vec<Point>; 3] {
    let moved = |motion: &RigidTransform, point: Point| -> Point {
        let moved = motion * Point3::from(point.map(f64::from));
        moved.map(|c| c as f32).into()
    };
    let rows = (0..pair.source.len()).filter(|&row| !pair.ground_source[row]);
    let (mut source, mut truth) = (Vec::new(), Vec::new());
    for row in rows {
        let aligned = moved(&pair.target_from_source, pair.source[row]);
        let there: Point = core::array::from_fn(|a| pair.source[row][a] + pair.flow[row][a]);
        source.push(aligned);
        truth.push(core::array::from_fn(|a| there[a] - aligned[a]));
    }
    let target = pair.target.iter().zip(&pair.ground_target);
    let target = target.filter(|&(_, &ground)| !ground).map(|(&p, _)| p);
    [source, target.collect(), truth]
}

#[test]
fn most_of_what_moves_on_a_street_is_found_and_little_else() {
    // Loose bounds: without motions the mean error of moving points is 0.5 to 0.65 m, here it is
    // below 0.2 m.
    const MOVING_M: f32 = 0.25;
    const STANDING_M: f32 = 0.02;
    for seed in 0..3 {
        let [source, target, truth] = residual_problem(&street(seed));
        let residual = found(&source, &target).motions.residual_at(&source);
        let length = |v: Point| v.iter().map(|x| x * x).sum::<f32>().sqrt();
        let mut sums = [(0.0, 0.0_f32); 2];
        for (residual, truth) in residual.iter().zip(truth) {
            let moves = usize::from(length(truth) >= 0.05);
            sums[moves].0 += length(core::array::from_fn(|a| residual[a] - truth[a]));
            sums[moves].1 += 1.0;
        }
        let [standing, moving] = sums.map(|(sum, count)| sum / count);
        assert!(moving < MOVING_M, "seed {seed}: {moving}");
        assert!(standing < STANDING_M, "seed {seed}: {standing}");
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let [source, target, _] = residual_problem(&street(4));
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let search = pool.expect("threads").install(|| found(&source, &target));
        (search.motions.residual_at(&source), search.cost_m.to_bits())
    };
    let one = on(1);
    assert!(one == on(2));
    assert!(one == on(5));
}

#[test]
fn an_interrupt_keeps_what_was_found_until_then() {
    /// Interrupts from a given number of checks on.
    struct After(usize, Interrupt, AtomicUsize);
    impl Control for After {
        fn interrupt(&self) -> Option<Interrupt> {
            (self.2.fetch_add(1, Ordering::Relaxed) >= self.0).then_some(self.1)
        }
    }
    let [source, target, _] = residual_problem(&street(5));
    let whole = found(&source, &target).clusters;
    let mut last = 0;
    for looks in [0, 2, 3, 4] {
        let control = After(looks, Interrupt::Deadline, AtomicUsize::new(0));
        let search = searched(&clouds(&source, &target), &control);
        assert_eq!(search.interrupted, Some(Interrupt::Deadline));
        assert!(search.clusters >= last && search.clusters < whole);
        last = search.clusters;
    }
    assert!(last > 0);
    let control = After(3, Interrupt::Cancelled, AtomicUsize::new(0));
    let search = searched(&clouds(&source, &target), &control);
    assert_eq!(search.interrupted, Some(Interrupt::Cancelled));
}

#[test]
fn a_device_is_not_asked_for_what_it_cannot_search() {
    let ask = |_: &PackedScene, _: &dyn Fn() -> bool| Err::<FoundInScene, ()>(());
    let mut random = Random::new(6);
    let [source, target] = [0.0, 0.8].map(|x| car(&mut random, [8.0 + x, 0.0]));
    let scattered: Vec<Point> = (0..20_u8).map(|i| [f32::from(i) * 3.0, 5.0, 0.0]).collect();
    let guesses = |initial_guesses: usize| ObjectOptions {
        initial_guesses,
        ..ObjectOptions::default()
    };
    let usual = ObjectOptions::default().initial_guesses;
    // It could search the first: that shows that it is asked.
    for (points, guesses, is_asked) in [
        (&source, guesses(usual), true),
        (&source, guesses(17), false),
        (&scattered, guesses(usual), false),
    ] {
        let clouds = clouds(points, &target);
        let on_device = find_objects(&clouds, &guesses, Some(&ask), &Uncontrolled);
        assert_eq!(on_device.is_err(), is_asked);
        if let Ok(found) = on_device {
            let on_host: Result<_, Infallible> =
                find_objects(&clouds, &guesses, None, &Uncontrolled);
            let expected = on_host.unwrap_or_else(|never| match never {});
            assert!(!found.on_device);
            assert_eq!(found.evidence, expected.evidence);
            assert_eq!(found.residual_of(points), expected.residual_of(points));
        }
    }
}
