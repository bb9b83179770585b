//! The search of nearest neighbors and the Chamfer distance on the GPU.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use super::{clouds, opened, scattered, shared};
use crate::flow::cpu::{CpuBackend, Isa};
use crate::flow::data::{Control, Interrupt, Point, Uncontrolled};
use crate::flow::field::{Advance, Backend};
use crate::flow::gpu::backend::Gpu;
use crate::flow::gpu::chamfer::GpuCloud;
use crate::flow::gpu::loss::{GpuLoss, GpuTarget};
use crate::flow::gpu::memory::GpuOptions;
use crate::flow::options::{
    ChamferOptions, EarlyStopOptions, FieldOptions, LossOptions, NearestSearch, Preset, Renewal,
};

const OPTIONS: ChamferOptions = ChamferOptions {
    truncation_m: 2.0,
    search: NearestSearch::BruteForce,
    renewal: None,
};

/// Half the sides of the box of the scattered points, metres.
const SPREAD: [f64; 3] = [40.0; 3];

fn squared(a: Point, b: Point) -> f64 {
    let off = |axis: usize| f64::from(a[axis]) - f64::from(b[axis]);
    (0..3).map(|axis| off(axis).powi(2)).sum()
}

#[test]
fn the_nearest_target_points_are_found_at_awkward_counts() {
    // Rounding of single-precision differences and sums, relative to the squared distance.
    const TOLERANCE: f64 = 1e-6;
    let Some(gpu) = shared() else {
        return;
    };
    for (points, targets) in [(0, 5), (1, 1), (63, 255), (64, 256), (65, 257), (700, 1500)] {
        let (points, target) = (scattered(points, SPREAD, 1), scattered(targets, SPREAD, 2));
        let cloud = GpuCloud::new(gpu.device(), points.len(), &target, &OPTIONS, &Uncontrolled);
        let nearest = cloud.expect("it fits").nearest(&points).expect("an answer");
        assert_eq!(nearest.len(), points.len());
        for (&point, found) in points.iter().zip(nearest) {
            let least = target.iter().map(|&site| squared(point, site));
            let least = least.fold(f64::INFINITY, f64::min);
            let found = squared(point, target[found as usize]);
            assert!(
                found <= least * (1.0 + TOLERANCE),
                "{targets}: {found} {least}"
            );
        }
    }
    let same = vec![[1.0, 2.0, 3.0]; 600];
    let cloud = GpuCloud::new(gpu.device(), 3, &same, &OPTIONS, &Uncontrolled);
    let nearest = cloud.expect("it fits").nearest(&scattered(3, SPREAD, 4));
    assert_eq!(
        nearest.expect("an answer"),
        [0; 3],
        "the first of equally near ones"
    );
}

#[test]
fn distances_to_a_target_cloud_are_the_cpus() {
    let Some(gpu) = shared() else {
        return;
    };
    let (points, target) = (scattered(500, SPREAD, 5), scattered(800, SPREAD, 6));
    let cpu = CpuBackend::new(Some(2)).expect("threads");
    let loss = LossOptions::Chamfer(OPTIONS);
    let [found, expected] = [gpu as &dyn Backend, &cpu].map(|device| {
        let prepared = device.prepare_target(&points, &target, &loss, &Uncontrolled);
        let prepared = prepared.expect("small clouds fit");
        prepared.distances(&points).expect("distances")
    });
    assert_eq!(found, expected);
}

#[test]
fn clouds_larger_than_the_memory_holds_at_once_have_the_loss_of_all() {
    // The software adapter holds 8,192 rows, so each iteration takes two waves.
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(9000);
    let options = Preset::NsfpBaseline.field();
    let run = |device: &dyn Backend| {
        let prepared = device.prepare_target(&source, &target, &options.loss, &Uncontrolled);
        let prepared = prepared.expect("the clouds fit");
        let mut trainer = prepared.start(&source, &options, 0).expect("a trainer");
        trainer.advance(2, &Uncontrolled).expect("iterations");
        let losses = trainer.report().best_loss;
        (losses, trainer.evaluate(&source).expect("a flow"))
    };
    let found = run(gpu);
    let same = Isa::available().into_iter().any(|isa| {
        let cpu = CpuBackend::with_isa(isa, Some(2)).expect("threads");
        run(&cpu) == found
    });
    assert!(same, "{}", found.0);
}

#[test]
fn iterations_in_pieces_have_the_bits_of_whole_ones() {
    let opened = opened(&GpuOptions::default());
    let (Some(whole), Some(mut pieces)) = (shared(), opened) else {
        return;
    };
    let device = Arc::get_mut(pieces.device_mut()).expect("one owner");
    // 900 x 1,500 points, both ways, take 2.7 million.
    let context = Arc::get_mut(&mut device.context).expect("one owner");
    context.most_distances = 300_000;
    let (source, target) = (scattered(900, SPREAD, 7), scattered(1500, SPREAD, 8));
    for preset in [Preset::NsfpBaseline, Preset::NsfpLinear] {
        let [expected, found] = [whole, &pieces].map(|gpu| {
            let options = preset.field();
            let prepared = gpu.prepare_target(&source, &target, &options.loss, &Uncontrolled);
            let prepared = prepared.expect("small clouds fit");
            let mut trainer = prepared.start(&source, &options, 0).expect("a trainer");
            trainer.advance(4, &Uncontrolled).expect("iterations");
            let losses = trainer.report().best_loss;
            (losses, trainer.evaluate(&source).expect("a flow"))
        });
        assert!(expected == found, "{preset:?}: {} {}", expected.0, found.0);
    }
    let cloud = |gpu: &Gpu| {
        let cloud = GpuCloud::new(gpu.device(), 900, &target, &OPTIONS, &Uncontrolled);
        cloud.expect("it fits").nearest(&source).expect("an answer")
    };
    assert_eq!(cloud(&pieces), cloud(whole));
}

/// Waits until `flag` is set.
fn until(flag: &AtomicBool) {
    let began = Instant::now();
    while !flag.load(Ordering::Relaxed) {
        assert!(began.elapsed() < Duration::from_secs(60), "in time");
        thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_pair_that_waits_for_the_submission_of_another_obeys_its_control() {
    /// Stops the submitting thread between two pieces of an iteration.
    #[derive(Default)]
    struct Submits {
        asked: AtomicUsize,
        submits: AtomicBool,
        may_go_on: AtomicBool,
    }
    impl Control for Submits {
        fn interrupt(&self) -> Option<Interrupt> {
            // The first time is before the iteration.
            if self.asked.fetch_add(1, Ordering::Relaxed) > 0 {
                self.submits.store(true, Ordering::Relaxed);
                until(&self.may_go_on);
            }
            None
        }
    }
    /// Is cancelled after its iteration was asked for.
    #[derive(Default)]
    struct Waits(AtomicUsize);
    impl Control for Waits {
        fn interrupt(&self) -> Option<Interrupt> {
            let asked = self.0.fetch_add(1, Ordering::Relaxed);
            (asked > 0).then_some(Interrupt::Cancelled)
        }
    }
    let two_lanes = GpuOptions {
        lanes: 2,
        ..GpuOptions::default()
    };
    let Some(mut gpu) = opened(&two_lanes) else {
        return;
    };
    let device = Arc::get_mut(gpu.device_mut()).expect("one owner");
    let context = Arc::get_mut(&mut device.context).expect("one owner");
    context.most_distances = 300_000;
    let (source, target) = (scattered(900, SPREAD, 7), scattered(1500, SPREAD, 8));
    let options = Preset::NsfpBaseline.field();
    let [first, second] = [(); 2].map(|()| {
        let prepared = gpu.prepare_target(&source, &target, &options.loss, &Uncontrolled);
        prepared.expect("small clouds fit")
    });
    let submits = Submits::default();
    let mut trainer = second.start(&source, &options, 0).expect("a trainer");
    thread::scope(|scope| {
        let (source, options, control) = (&source, &options, &submits);
        let submitting = scope.spawn(move || {
            let mut trainer = first.start(source, options, 0).expect("a trainer");
            trainer.advance(1, control)
        });
        until(&submits.submits);
        let ended = trainer.advance(1, &Waits::default()).expect("no failure");
        assert_eq!(ended, Advance::Interrupted(Interrupt::Cancelled));
        submits.may_go_on.store(true, Ordering::Relaxed);
        let ended = submitting.join().expect("no panic").expect("iterations");
        assert_eq!(ended, Advance::Continues);
    });
    assert_eq!(trainer.report().iterations, 0);
    trainer.advance(1, &Uncontrolled).expect("an iteration");
    assert_eq!(trainer.report().iterations, 1);
}

#[test]
fn submissions_end_where_the_state_of_the_fit_can_be_taken() {
    let Some(gpu) = shared() else {
        return;
    };
    let target = scattered(10, SPREAD, 9);
    let options = ChamferOptions {
        renewal: Some(Renewal { first: 4, every: 5 }),
        ..OPTIONS
    };
    let cloud = GpuCloud::new(gpu.device(), 10, &target, &options, &Uncontrolled);
    let cloud = cloud.expect("it fits");
    let loss = GpuLoss::new(GpuTarget::Cloud(&cloud), &LossOptions::Chamfer(options));
    let loss = loss.expect("a loss for clouds");
    // Searches precede the iterations after 0, 1, 2, 3, 4, 9, 14, 19, ... others.
    for (done, steps, ended) in [(0, 16, 14), (0, 3, 3), (4, 16, 19), (9, 4, 13), (13, 4, 14)] {
        let steps = loss.up_to_a_search(done, steps);
        assert_eq!(done + steps, ended);
    }
}

#[test]
fn a_flow_that_leaves_the_scene_ends_the_fit() {
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(200);
    for preset in [Preset::NsfpBaseline, Preset::NsfpLinear] {
        let options = FieldOptions {
            learning_rate: 1e9,
            early_stop: None::<EarlyStopOptions>,
            ..preset.field()
        };
        let prepared = gpu.prepare_target(&source, &target, &options.loss, &Uncontrolled);
        let prepared = prepared.expect("small clouds fit");
        let mut trainer = prepared.start(&source, &options, 0).expect("a trainer");
        let ended = trainer.advance(5, &Uncontrolled).expect("iterations");
        assert_eq!(ended, Advance::Diverged, "{preset:?}");
        assert_eq!(trainer.report().iterations, 1, "{preset:?}");
    }
}
