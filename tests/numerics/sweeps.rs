//! Tests of estimates with neighbor sweeps. `benches/accuracy/neighbors.rs` prints the measured figures.

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::Metrics;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{
    Control, Estimate, FlowError, Ground, Options, Preset, Problem, Sequence, Sweep, Uncontrolled,
    estimate, window,
};
use fnsf::formats::{Pair, PairTruth, read_cloud};

use super::real_data::real_data;
use super::scenes::{real_pair, scored};

/// Preset `label` with a window of `sweeps` sweeps.
fn seeing(sweeps: usize) -> Options {
    let mut options = Preset::Label.options(None);
    options.objects_mut().expect("objects").sweeps = sweeps;
    options
}

/// Estimates pair `pair` of `sweeps`, with all other sweeps as neighbor sweeps.
fn alone(sweeps: &[Sweep], pair: usize, options: &Options, control: &dyn Control) -> Estimate {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let others = (0..sweeps.len()).filter(|&index| index != pair && index != pair + 1);
    let others = others.map(|index| sweeps[index].as_neighbor(index as i8 - pair as i8));
    let neighbors: Vec<_> = others.collect();
    let [source, target] = [pair, pair + 1].map(|index| &sweeps[index]);
    let ground = source.ground.as_deref().zip(target.ground.as_deref());
    let problem = Problem {
        source: &source.points,
        target: &target.points,
        ground: ground.map(<[_; 2]>::from),
        times: None,
        before: None,
        neighbors: &neighbors,
    };
    estimate(&backend, &problem, options, control).expect("a flow")
}

fn drive(seed: u64, sweeps: usize, beams: usize) -> (Street, Vec<Sweep>) {
    let options = StreetOptions {
        seed,
        sweeps,
        beams,
        azimuth_steps: 1000,
        ..StreetOptions::default()
    };
    let street = Street::new(&options).expect("a street");
    let sweep = |index| {
        let frame = street.sweep(index).expect("a frame");
        Sweep {
            points: frame.points,
            ground: Some(frame.ground),
            ..Sweep::default()
        }
    };
    let sweeps = (0..sweeps).map(sweep).collect();
    (street, sweeps)
}

fn known(street: &Street, pair: usize) -> Pair {
    let pair = street.pair(pair).expect("a pair");
    Pair {
        truth: Some(PairTruth {
            valid: vec![true; pair.source.len()],
            flow: pair.flow,
            dynamic: Some(pair.dynamic),
            category: None,
            foreground: Some(pair.foreground),
        }),
        ground: Some(fnsf::formats::Ground {
            source: pair.ground_source,
            target: pair.ground_target,
        }),
        ego: Some(pair.target_from_source),
        source: pair.source,
        target: pair.target,
    }
}

fn moving(metrics: &Metrics) -> f64 {
    metrics.epe_dynamic.expect("something moves")
}

fn still(metrics: &Metrics) -> f64 {
    metrics.epe_static.expect("something stands")
}

#[test]
fn a_pair_that_fails_costs_no_other_that_was_there_before_it() {
    let (_, mut sweeps) = drive(0, 5, 16);
    sweeps[3] = Sweep::default();
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let (options, mut sequence) = (seeing(5), Sequence::default());
    let mut found = Vec::new();
    for sweep in sweeps {
        let pushed = sequence.push(&backend, sweep, &options, &Uncontrolled);
        found.extend(pushed.expect("those before the empty sweep"));
    }
    assert_eq!(found.len(), 2);
    for _ in 0..2 {
        let rest = sequence.finish(&backend, &Uncontrolled);
        assert!(matches!(rest, Err(FlowError::TooFewPoints { .. })));
    }
}

#[test]
fn a_sweep_of_another_scene_before_a_cut_changes_no_flow_after_it() {
    let (_, after) = drive(0, 3, 32);
    let (_, before) = drive(77, 1, 32);
    let expected = alone(&after, 0, &seeing(5), &Uncontrolled);
    let joined = [before, after].concat();
    let found = alone(&joined, 1, &seeing(5), &Uncontrolled);
    assert_eq!(found.flow, expected.flow);
    // Its own sweeps do change it.
    let alone_of_two = alone(&joined[1..3], 0, &seeing(5), &Uncontrolled);
    assert_ne!(found.objects(), alone_of_two.objects());
}

#[test]
fn how_many_sweeps_a_pair_sees_is_fixed_by_the_first_one() {
    let (_, sweeps) = drive(0, 6, 16);
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let mut sequence = Sequence::default();
    let mut found = 0;
    for (sweep, count) in sweeps.into_iter().zip([2, 2, 2, 5, 5, 3]) {
        let pushed = sequence.push(&backend, sweep, &seeing(count), &Uncontrolled);
        found += pushed.expect("flows").len();
    }
    assert_eq!(found, 5);
}

#[test]
fn five_sweeps_beat_two_on_streets_for_what_moves_and_not_at_the_cost_of_what_stands() {
    /// Maximum ratio of the error of moving points. On full streets it is four fifths: fast objects
    /// are found from two sweeps alone.
    const LEFT: f64 = 0.9;
    /// Maximum mean error of the moving points, metres. Without estimated motions it is 0.6.
    const MOST: f64 = 0.12;
    /// Tolerance of the mean error of the static points, metres: a tenth of that error.
    const SAME: f64 = 0.2e-3;
    let (mut two, mut five) = ([0.0; 2], [0.0; 2]);
    for seed in 0..3 {
        let (street, sweeps) = drive(seed, 5, 32);
        for pair in [0, 2] {
            let known = known(&street, pair);
            for (sums, count) in [(&mut two, 2), (&mut five, 5)] {
                let options = seeing(count);
                let metrics = scored(&known, &alone(&sweeps, pair, &options, &Uncontrolled));
                sums[0] += moving(&metrics);
                sums[1] += still(&metrics);
            }
        }
    }
    assert!(five[0] <= two[0] * LEFT, "moving: {five:?}, {two:?}");
    assert!(five[0] / 6.0 <= MOST, "moving: {five:?}");
    assert!(five[1] <= two[1] + 6.0 * SAME, "still: {five:?}, {two:?}");
}

#[test]
fn five_sweeps_are_as_good_as_two_on_a_real_drive() {
    const NAME: &str = "kitti_0000";
    let Some(pair) = real_pair(NAME) else { return };
    let folder = real_data()
        .expect("the pair was read from there")
        .join(NAME);
    let ground = pair.ground.clone().expect("the pair has ground masks");
    let sweep = |points, ground| Sweep {
        points,
        ground,
        ..Sweep::default()
    };
    let mut sweeps = vec![
        sweep(pair.source.clone(), Some(ground.source)),
        sweep(pair.target.clone(), Some(ground.target)),
    ];
    for index in 2..5 {
        let name = format!("{index:010}.pcd");
        let bytes = std::fs::read(folder.join(&name)).expect("the drive has the sweep");
        let cloud = read_cloud(&bytes, Some(&name)).expect("the sweep is sound");
        let options = seeing(5);
        sweeps.push(sweep(cloud.points, None).prepared(&options));
    }
    let [two, five] = [2, 5].map(|count| {
        let options = Options {
            ground: Ground::Mask,
            ..seeing(count)
        };
        scored(&pair, &alone(&sweeps, 0, &options, &Uncontrolled))
    });
    // What two sweeps leave is mostly the noise of the tracked boxes.
    let bounds = [moving(&two) + 0.0005, still(&two) + 0.0001];
    assert!(moving(&five) <= bounds[0], "{five:?}, {two:?}");
    assert!(still(&five) <= bounds[1], "{five:?}, {two:?}");
}

#[test]
fn without_sweeps_around_or_where_two_are_asked_for_a_pair_is_what_it_is_alone() {
    let (_, sweeps) = drive(4, 4, 16);
    let pair = alone(&sweeps[1..3], 0, &seeing(2), &Uncontrolled);
    assert_eq!(
        pair.flow,
        alone(&sweeps[1..3], 0, &seeing(5), &Uncontrolled).flow
    );
    assert_eq!(pair.flow, alone(&sweeps, 1, &seeing(2), &Uncontrolled).flow);
    assert_ne!(pair.flow, alone(&sweeps, 1, &seeing(4), &Uncontrolled).flow);
    let other = Preset::Paper.options(Some(500));
    let paper = alone(&sweeps[1..3], 0, &other, &Uncontrolled);
    assert_eq!(paper.flow, alone(&sweeps, 1, &other, &Uncontrolled).flow);
}

#[test]
fn where_time_is_short_the_sweeps_around_are_done_without_first() {
    /// Always this many seconds left.
    struct Left(f64);
    impl Control for Left {
        fn seconds_left(&self) -> Option<f64> {
            Some(self.0)
        }
    }
    let (_, sweeps) = drive(4, 5, 16);
    let pair = alone(&sweeps[2..4], 0, &seeing(2), &Uncontrolled);
    let whole = alone(&sweeps, 2, &seeing(5), &Uncontrolled);
    // This suffices for the ego motion of clouds of 15,000 points, and not for a neighbor sweep.
    assert_eq!(pair.flow, alone(&sweeps, 2, &seeing(5), &Left(0.03)).flow);
    assert_eq!(whole.flow, alone(&sweeps, 2, &seeing(5), &Left(60.0)).flow);
    assert_ne!(whole.flow, pair.flow);
}

#[test]
fn a_pair_of_a_sequence_has_the_bits_of_its_window_alone_and_comes_as_soon_as_that_is_whole() {
    const SWEEPS: usize = 7;
    let (_, sweeps) = drive(5, SWEEPS, 16);
    for (count, ready) in [(2, [0, 1, 1, 1, 1, 1, 1]), (5, [0, 0, 0, 0, 3, 1, 1])] {
        let (options, backend) = (seeing(count), CpuBackend::new(Some(2)).expect("threads"));
        let mut sequence = Sequence::default();
        let mut estimates = Vec::new();
        for (sweep, flows) in sweeps.iter().zip(ready) {
            let pushed = sequence.push(&backend, sweep.clone(), &options, &Uncontrolled);
            let pushed = pushed.expect("flows");
            assert_eq!(pushed.len(), flows);
            estimates.extend(pushed);
        }
        estimates.extend(sequence.finish(&backend, &Uncontrolled).expect("the rest"));
        assert_eq!(estimates.len(), SWEEPS - 1);
        for (pair, estimate) in estimates.iter().enumerate() {
            let seen = window(pair, SWEEPS, count);
            let first = seen.start;
            let other = alone(&sweeps[seen], pair - first, &options, &Uncontrolled);
            assert_eq!(estimate.flow, other.flow, "pair {pair} of {count} sweeps");
            assert_eq!(estimate.motion.to_bytes(), other.motion.to_bytes());
        }
        let rest = sequence.finish(&backend, &Uncontrolled).expect("nothing");
        assert!(rest.is_empty());
    }
}
