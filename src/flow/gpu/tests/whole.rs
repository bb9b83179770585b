//! Whole runs: against the CPU backend on loss and error, and against themselves bit by bit.

use std::sync::Mutex;

use super::{LANES, clouds, shared};
use crate::flow::backend::Backend;
use crate::flow::cpu::CpuBackend;
use crate::flow::early_stop::EarlyStop;
use crate::flow::field::Field;
use crate::flow::options::{Ground, Options, Preset};
use crate::flow::points::Point;
use crate::flow::preprocess::Problem;
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};
use crate::flow::solver::{Estimate, estimate};
use crate::flow::watch::{Progress, Unwatched, Watch};

/// Collects the losses.
#[derive(Default)]
pub(super) struct Losses(Mutex<Vec<f64>>);

impl Losses {
    pub(super) fn taken(self) -> Vec<f64> {
        self.0.into_inner().expect("no test panics in it")
    }
}

impl Watch for Losses {
    fn progress(&self, progress: Progress) {
        let mut losses = self.0.lock().expect("no test panics in it");
        losses.push(progress.loss);
    }
}

pub(super) fn street(seed: u64) -> SimulatedPair {
    let options = StreetOptions {
        seed,
        beams: 16,
        azimuth_steps: 300,
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).and_then(|street| street.pair(0));
    pair.expect("a small street")
}

pub(super) fn solved(backend: &dyn Backend, pair: &SimulatedPair, options: &Options) -> Estimate {
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: None,
        before: None,
        around: &[],
    };
    estimate(backend, &problem, options, &Unwatched).expect("a flow")
}

pub(super) fn end_point_error(flow: &[Point], truth: &[Point]) -> f64 {
    let errors = flow.iter().zip(truth).map(|(f, t)| {
        let square: f32 = (0..3).map(|a| (f[a] - t[a]).powi(2)).sum();
        f64::from(square.sqrt())
    });
    errors.sum::<f64>() / flow.len() as f64
}

#[test]
fn the_card_finds_the_cpus_flow() {
    // Rounding sends two runs of one seed apart; these are their distances in loss and error.
    const LOSS: f64 = 0.05;
    const ERROR_M: f64 = 0.02;
    let Some(gpu) = shared() else {
        return;
    };
    let cpu = CpuBackend::new(Some(2)).expect("threads");
    let pair = street(1);
    for preset in Preset::FITTED {
        let mut options = preset.options(Some(1500));
        // Ours to its end: half-way the runs are farther apart.
        options.max_iterations = options.max_iterations.min(150);
        let [ours, theirs] = [gpu as &dyn Backend, &cpu].map(|device| {
            let estimate = solved(device, &pair, &options);
            let kept = |points: &[Point]| -> Vec<Point> {
                let rows = points.iter().zip(&estimate.valid);
                rows.filter(|&(_, &valid)| valid).map(|(&p, _)| p).collect()
            };
            let error = end_point_error(&kept(&estimate.flow), &kept(&pair.flow));
            (estimate, error)
        });
        let loss = (ours.0.best_loss - theirs.0.best_loss).abs() / theirs.0.best_loss;
        assert!(loss < LOSS, "{preset:?}: {loss}");
        let error = (ours.1 - theirs.1).abs();
        assert!(error < ERROR_M, "{preset:?}: {} {}", ours.1, theirs.1);
        assert_eq!(ours.0.iterations, theirs.0.iterations, "{preset:?}");
    }
}

#[test]
fn a_field_that_was_kept_says_on_the_card_what_its_run_said_and_on_the_cpu_about_that() {
    // Metres: single precision through nine layers, summed in another order.
    const ROUNDING_M: f32 = 1e-3;
    let Some(gpu) = shared() else {
        return;
    };
    let pair = street(2);
    let mut options = Preset::Neural.options(None);
    options.max_iterations = 8;
    options.ground = Ground::Keep;
    let estimate = solved(gpu, &pair, &options);
    let field = Field::from_bytes(&estimate.field.to_bytes()).expect("sound bytes");
    let places = field.static_places(&pair.source);
    let there = field.residual(gpu, &places).expect("flows");
    for (row, (residual, place)) in there.iter().zip(&places).enumerate() {
        let from = pair.source[row];
        let flow: Point = core::array::from_fn(|a| (place[a] - from[a]) + residual[a]);
        assert_eq!(flow, estimate.flow[row], "row {row}");
    }
    let cpu = CpuBackend::new(Some(2)).expect("threads");
    let here = field.residual(&cpu, &places).expect("flows");
    for (there, here) in there.iter().zip(&here) {
        assert!((0..3).all(|a| (there[a] - here[a]).abs() < ROUNDING_M));
    }
}

#[test]
fn a_run_in_batches_begins_as_on_the_cpu() {
    // Relative, and metres: rounding alone, before it has grown.
    const LOSS: f64 = 1e-4;
    const FLOW_M: f32 = 1e-3;
    const STEPS: usize = 12;
    let Some(gpu) = shared() else {
        return;
    };
    let cpu = CpuBackend::new(Some(2)).expect("threads");
    let [source, target] = clouds(1500);
    let options = batched();
    let [ours, theirs] = [gpu as &dyn Backend, &cpu].map(|device| {
        let transform = device
            .transform(&source, &target, &options.distance, &Unwatched)
            .expect("small clouds fit");
        let losses = Losses::default();
        let mut trainer = transform.start(&source, &options).expect("a trainer");
        trainer.advance(STEPS, &losses).expect("iterations");
        (
            losses.taken(),
            trainer.evaluate(&source).expect("an answer"),
        )
    });
    assert_eq!(ours.0.len(), STEPS);
    for (loss, expected) in ours.0.iter().zip(&theirs.0) {
        let error = (loss - expected).abs() / expected;
        assert!(error < LOSS, "{:?} {:?}", ours.0, theirs.0);
    }
    for (flow, expected) in ours.1.iter().flatten().zip(theirs.1.iter().flatten()) {
        assert!((flow - expected).abs() < FLOW_M, "{flow} {expected}");
    }
}

#[test]
fn the_stopping_rule_and_the_best_are_the_cpus_for_the_same_losses() {
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(500);
    let mut options = Preset::Paper.options(None);
    // Steps this long overshoot after a while.
    options.learning_rate = 0.03;
    options.max_iterations = 120;
    let transform = gpu
        .transform(&source, &target, &options.distance, &Unwatched)
        .expect("small clouds fit");
    let losses = Losses::default();
    let mut trainer = transform.start(&source, &options).expect("a trainer");
    trainer.advance(200, &losses).expect("iterations");
    let report = trainer.report();
    let losses = losses.taken();
    let mut rule = EarlyStop::new(options.early_stop.expect("the paper has one"));
    let stop = losses.iter().position(|&loss| rule.observe(loss));
    let stop = stop.expect("it stops before the end");
    assert_eq!(
        stop + 1,
        losses.len(),
        "iterations after the stop were done"
    );
    assert_eq!(report.iterations, losses.len());
    let candidates = &losses[..stop];
    let lowest = candidates.iter().copied().fold(f64::INFINITY, f64::min);
    assert_eq!(report.best_loss, lowest);
    let last = candidates.iter().rposition(|&loss| loss == lowest);
    assert_eq!(last.map(|place| place + 1), Some(report.best_iteration));
}

/// The flow of a pair that is fitted for `steps` iterations.
fn fitted(device: &dyn Backend, points: usize, options: &Options, steps: usize) -> Vec<Point> {
    let [source, target] = clouds(points);
    let transform = device
        .transform(&source, &target, &options.distance, &Unwatched)
        .expect("small clouds fit");
    let mut trainer = transform.start(&source, options).expect("a trainer");
    trainer.advance(steps, &Unwatched).expect("iterations");
    trainer.evaluate(&source).expect("an answer")
}

fn batched() -> Options {
    let mut options = Preset::Neural.options(None);
    options.batch = Some(300);
    options
}

#[test]
fn a_pair_has_the_same_bits_alone_and_among_others() {
    let Some(gpu) = shared() else {
        return;
    };
    let sizes = [700, 901, 64];
    assert!(sizes.len() < LANES);
    for options in [batched(), Preset::Paper.options(None)] {
        let alone = sizes.map(|points| fitted(gpu, points, &options, 12));
        let together = std::thread::scope(|scope| {
            let options = &options;
            let pairs = sizes.map(|points| {
                let gpu = gpu.clone();
                scope.spawn(move || fitted(&gpu, points, options, 12))
            });
            pairs.map(|pair| pair.join().expect("no panic"))
        });
        for (alone, together) in alone.iter().zip(&together) {
            assert!(alone == together, "{} points", alone.len());
        }
    }
}

#[test]
fn a_pair_put_down_and_taken_up_again_has_the_same_bits() {
    let Some(gpu) = shared() else {
        return;
    };
    for options in [batched(), Preset::Paper.options(None)] {
        let expected = fitted(gpu, 600, &options, 14);
        let [source, target] = clouds(600);
        let transform = gpu
            .transform(&source, &target, &options.distance, &Unwatched)
            .expect("small clouds fit");
        let mut first = transform.start(&source, &options).expect("a trainer");
        first.advance(5, &Unwatched).expect("iterations");
        let state = first.state().expect("an answer");
        drop(first);
        let mut second = transform.start(&source, &options).expect("a trainer");
        second.restore(state).expect("memory");
        second.advance(9, &Unwatched).expect("iterations");
        assert!(second.evaluate(&source).expect("an answer") == expected);
    }
}

#[test]
fn a_zero_start_is_no_flow() {
    let Some(gpu) = shared() else {
        return;
    };
    let flow = fitted(gpu, 100, &batched(), 0);
    assert!(flow.iter().flatten().all(|&f| f == 0.0));
}
