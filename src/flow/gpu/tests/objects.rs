//! The object search with its clusters searched on the GPU, compared with the host's search.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use super::shared;
use super::whole::{end_point_error, solved};
use crate::flow::cpu::CpuBackend;
use crate::flow::data::{Control, Interrupt, Point, Uncontrolled};
use crate::flow::estimate::{Estimate, estimate};
use crate::flow::field::Backend;
use crate::flow::options::{Ego, Ground, Options, Preset};
use crate::flow::problem::{NeighborSweep, Problem};
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};

fn street(seed: u64) -> (Street, SimulatedPair) {
    let options = StreetOptions {
        seed,
        beams: 24,
        azimuth_steps: 700,
        sweeps: 4,
        ..StreetOptions::default()
    };
    let street = Street::new(&options).expect("a street");
    let pair = street.pair(1).expect("a pair");
    (street, pair)
}

/// The share of the points whose flows differ by less than 2 cm.
fn agreement(a: &[Point], b: &[Point]) -> f64 {
    const ALIKE_M: f32 = 0.02;
    let alike = a.iter().zip(b).filter(|(a, b)| {
        let square: f32 = (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum();
        square < ALIKE_M * ALIKE_M
    });
    alike.count() as f64 / a.len() as f64
}

/// For each point the probability that its flow is right.
fn confidence(estimate: &Estimate) -> &[f32] {
    let objects = estimate.objects().expect("an object search");
    &objects.confidence
}

/// Number of clusters that were searched.
fn searched(estimate: &Estimate) -> usize {
    let search = estimate.object_search().expect("an object search");
    search.searched
}

#[test]
fn a_card_finds_the_objects_that_the_host_finds() {
    const ALIKE: f64 = 0.99;
    let Some(gpu) = shared() else {
        return;
    };
    let cpu = CpuBackend::new(Some(2)).expect("threads");
    for seed in [3, 4] {
        let (_, pair) = street(seed);
        let options = Preset::Default.options(None);
        let [card, host] =
            [gpu as &dyn Backend, &cpu].map(|backend| solved(backend, &pair, &options));
        assert_eq!(card.device, gpu.name());
        assert_eq!(searched(&card), searched(&host));
        assert!(searched(&card) > 20);
        let alike = agreement(&card.flow, &host.flow);
        assert!(alike > ALIKE, "street {seed}: {alike}");
        let errors = [&card, &host].map(|found| end_point_error(&found.flow, &pair.flow));
        assert!(errors[0] < errors[1] * 1.05, "street {seed}: {errors:?}");
    }
}

#[test]
fn a_card_searches_neighbor_sweeps_as_the_host_does() {
    const ALIKE: f64 = 0.99;
    let Some(gpu) = shared() else {
        return;
    };
    let cpu = CpuBackend::new(Some(2)).expect("threads");
    let (street, pair) = street(5);
    let around = [(0, -1), (3, 2)].map(|(index, at)| (street.sweep(index).expect("a sweep"), at));
    let neighbors = around.each_ref().map(|(sweep, at)| NeighborSweep {
        points: &sweep.points,
        ground: None,
        times: None,
        at: *at,
    });
    let problem = Problem {
        neighbors: &neighbors,
        ..Problem::pair(&pair.source, &pair.target)
    };
    let options = Preset::Label.options(None);
    let found = |backend: &dyn Backend| {
        estimate(backend, &problem, &options, &Uncontrolled).expect("a flow")
    };
    let (card, host) = (found(gpu), found(&cpu));
    assert_eq!(card.device, gpu.name());
    let alike = agreement(&card.flow, &host.flow);
    assert!(alike > ALIKE, "{alike}");
    // It depends on the distances along the normals.
    let [of_card, of_host] = [&card, &host].map(confidence);
    assert_eq!(of_card.len(), of_host.len());
    let both = of_card.iter().zip(of_host);
    let alike = both.filter(|(a, b)| (*a - *b).abs() < 0.01).count() as f64;
    assert!(alike > ALIKE * of_host.len() as f64, "{alike}");
}

#[test]
fn clusters_of_pairs_that_are_searched_together_have_the_bits_of_those_of_a_pair_alone() {
    const PAIRS: u64 = 3;
    let Some(gpu) = shared() else {
        return;
    };
    let options = Preset::Default.options(None);
    let pairs: Vec<SimulatedPair> = (3..3 + PAIRS).map(|seed| street(seed).1).collect();
    let found = |pair: &SimulatedPair| solved(gpu, pair, &options).flow;
    let alone: Vec<Vec<Point>> = pairs.iter().map(found).collect();
    let together: Vec<Vec<Point>> = thread::scope(|scope| {
        let found = &found;
        let threads: Vec<_> = pairs
            .iter()
            .map(|pair| scope.spawn(move || found(pair)))
            .collect();
        let joined = threads.into_iter();
        joined.map(|pair| pair.join().expect("no panic")).collect()
    });
    assert_eq!(together, alone);
}

#[test]
fn clouds_without_clusters_are_left_to_the_host() {
    let Some(gpu) = shared() else {
        return;
    };
    let scattered: Vec<Point> = (0..60_u8)
        .map(|i| [f32::from(i % 8) * 4.0, f32::from(i / 8) * 4.0, 1.0])
        .collect();
    let options = Options {
        ego: Ego::Off,
        ground: Ground::Keep,
        ..Preset::Default.options(None)
    };
    let problem = Problem::pair(&scattered, &scattered);
    let found = estimate(gpu, &problem, &options, &Uncontrolled).expect("a flow");
    assert_eq!(searched(&found), 0);
    assert_ne!(found.device, gpu.name());
    assert!(gpu.device().context.watchdog.check().is_ok());
}

#[test]
fn a_card_that_is_interrupted_leaves_the_clusters_at_rest() {
    /// Interrupts from a given number of looks on.
    struct After(usize, AtomicUsize);
    impl Control for After {
        fn interrupt(&self) -> Option<Interrupt> {
            let late = self.1.fetch_add(1, Ordering::Relaxed) >= self.0;
            late.then_some(Interrupt::Deadline)
        }
    }
    let Some(gpu) = shared() else {
        return;
    };
    let (_, pair) = street(3);
    let problem = Problem::pair(&pair.source, &pair.target);
    let options = Options {
        ground: Ground::Keep,
        ..Preset::Default.options(None)
    };
    let mut last = 0;
    for looks in [0, 20, 10_000] {
        let control = After(looks, AtomicUsize::new(0));
        let found = estimate(gpu, &problem, &options, &control).expect("a flow");
        assert!(searched(&found) >= last);
        last = searched(&found);
    }
    assert!(last > 0);
}
