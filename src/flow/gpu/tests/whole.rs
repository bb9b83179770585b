//! Whole fits, compared bit by bit with the CPU backend and with each other.

use std::sync::Mutex;

use super::{LANES, clouds, shared};
use crate::flow::cpu::{CpuBackend, Isa};
use crate::flow::data::{Control, Point, Progress, Uncontrolled};
use crate::flow::estimate::{Estimate, estimate};
use crate::flow::field::{Backend, EarlyStop};
use crate::flow::motion::MotionField;
use crate::flow::options::{FieldOptions, Ground, LossOptions, Options, Preset, Renewal};
use crate::flow::problem::Problem;
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};

/// Collects the losses.
#[derive(Default)]
pub(super) struct Losses(Mutex<Vec<f64>>);

impl Losses {
    pub(super) fn taken(self) -> Vec<f64> {
        self.0.into_inner().expect("no test panics in it")
    }
}

impl Control for Losses {
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
    let problem = Problem::pair(&pair.source, &pair.target);
    estimate(backend, &problem, options, &Uncontrolled).expect("a flow")
}

pub(super) fn end_point_error(flow: &[Point], truth: &[Point]) -> f64 {
    let errors = flow.iter().zip(truth).map(|(f, t)| {
        let square: f32 = (0..3).map(|a| (f[a] - t[a]).powi(2)).sum();
        f64::from(square.sqrt())
    });
    errors.sum::<f64>() / flow.len() as f64
}

/// The CPU backend with each available instruction set.
fn cpus() -> Vec<CpuBackend> {
    let sets = Isa::available().into_iter();
    sets.map(|isa| CpuBackend::with_isa(isa, Some(2)).expect("threads"))
        .collect()
}

/// Asserts that the GPU's result is bit-identical to the CPU's with one of its instruction sets.
/// They differ in whether a product is rounded before it is added, and so do GPUs.
fn assert_among<T: PartialEq>(found: &T, of: impl Fn(&CpuBackend) -> T, what: &str) {
    assert!(cpus().iter().any(|cpu| of(cpu) == *found), "{what}");
}

#[test]
fn a_card_finds_the_bits_of_the_cpu_that_rounds_as_it_does() {
    let Some(gpu) = shared() else {
        return;
    };
    let pair = street(1);
    for preset in Preset::with_gpu_kernels() {
        let mut options = preset.options(Some(400));
        options.field_mut().expect("a field").max_iterations = 10;
        let found = |device: &dyn Backend| {
            let found = solved(device, &pair, &options);
            let fit = found.fit().expect("a fit");
            let ends = (fit.iterations, fit.best_iteration, fit.best_loss);
            (found.flow, ends, found.motion.to_bytes())
        };
        assert_among(&found(gpu), |cpu| found(cpu), preset.name());
    }
}

#[test]
fn every_loss_of_a_run_in_batches_is_the_cpus() {
    const STEPS: usize = 10;
    let Some(gpu) = shared() else {
        return;
    };
    let mut stopping = batched();
    stopping.early_stop = Preset::Paper.field().early_stop;
    let in_batches = others().into_iter().map(|options| FieldOptions {
        batch: Some(150),
        ..options
    });
    for options in [batched(), stopping, renewed()]
        .into_iter()
        .chain(in_batches)
    {
        let run = |device: &dyn Backend| {
            let [source, target] = clouds(400);
            let transform = device
                .prepare_target(&source, &target, &options.loss, &Uncontrolled)
                .expect("small clouds fit");
            let losses = Losses::default();
            let mut trainer = transform.start(&source, &options, 0).expect("a trainer");
            trainer.advance(STEPS, &losses).expect("iterations");
            let flow = trainer.evaluate(&source).expect("an answer");
            (losses.taken(), flow)
        };
        assert_among(&run(gpu), |cpu| run(cpu), &format!("{options:?}"));
    }
}

#[test]
fn a_field_that_was_kept_says_on_any_device_what_its_run_said() {
    let Some(gpu) = shared() else {
        return;
    };
    let pair = street(2);
    let mut options = Preset::Neural.options(None);
    options.field_mut().expect("a field").max_iterations = 8;
    options.ground = Ground::Keep;
    let estimate = solved(gpu, &pair, &options);
    let field = MotionField::from_bytes(&estimate.motion.to_bytes()).expect("sound bytes");
    let indices = field.static_positions(&pair.source);
    let there = field.residual(gpu, &indices).expect("flows");
    for (row, (residual, index)) in there.iter().zip(&indices).enumerate() {
        let from = pair.source[row];
        let flow: Point = core::array::from_fn(|a| (index[a] - from[a]) + residual[a]);
        assert_eq!(flow, estimate.flow[row], "row {row}");
    }
    let here = |cpu: &CpuBackend| field.residual(cpu, &indices).expect("flows");
    assert_among(&there, here, "residuals");
}

#[test]
fn the_stopping_rule_and_the_best_are_the_cpus_for_the_same_losses() {
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(500);
    let mut options = Preset::Paper.field();
    // Steps of this length overshoot after some iterations.
    options.learning_rate = 0.03;
    options.max_iterations = 120;
    let transform = gpu
        .prepare_target(&source, &target, &options.loss, &Uncontrolled)
        .expect("small clouds fit");
    let losses = Losses::default();
    let mut trainer = transform.start(&source, &options, 0).expect("a trainer");
    trainer.advance(200, &losses).expect("iterations");
    let report = trainer.report();
    let losses = losses.taken();
    let mut rule = EarlyStop::new(options.early_stop.expect("the paper has one"));
    let stop = losses.iter().position(|&loss| rule.observe(loss as f32));
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
    assert_eq!(last.map(|index| index + 1), Some(report.best_iteration));
}

/// The flow of a pair after `steps` iterations.
fn fitted(device: &dyn Backend, points: usize, options: &FieldOptions, steps: usize) -> Vec<Point> {
    let [source, target] = clouds(points);
    let transform = device
        .prepare_target(&source, &target, &options.loss, &Uncontrolled)
        .expect("small clouds fit");
    let mut trainer = transform.start(&source, options, 0).expect("a trainer");
    trainer.advance(steps, &Uncontrolled).expect("iterations");
    trainer.evaluate(&source).expect("an answer")
}

/// The published methods that have kernels, besides `paper`: the linear model and the Chamfer
/// distance, together and apart.
fn others() -> Vec<FieldOptions> {
    let others = Preset::with_gpu_kernels();
    let others = others.filter(|preset| !matches!(preset, Preset::Neural | Preset::Paper));
    others.map(Preset::field).collect()
}

/// A Chamfer distance whose neighbors are searched in every third iteration after two.
fn renewed() -> FieldOptions {
    let mut options = Preset::NsfpBaseline.field();
    let LossOptions::Chamfer(loss) = &mut options.loss else {
        panic!("a Chamfer distance");
    };
    loss.renewal = Some(Renewal { first: 2, every: 3 });
    options
}

fn batched() -> FieldOptions {
    let mut options = Preset::Neural.field();
    options.batch = Some(150);
    options
}

#[test]
fn a_pair_has_the_same_bits_alone_and_among_others() {
    const STEPS: usize = 6;
    let Some(gpu) = shared() else {
        return;
    };
    let sizes = [200, 301, 64];
    assert!(sizes.len() < LANES);
    for options in [batched(), Preset::Paper.field()]
        .into_iter()
        .chain(others())
    {
        let alone = sizes.map(|points| fitted(gpu, points, &options, STEPS));
        let together = std::thread::scope(|scope| {
            let options = &options;
            let pairs = sizes.map(|points| {
                let gpu = gpu.clone();
                scope.spawn(move || fitted(&gpu, points, options, STEPS))
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
    let restored = [batched(), Preset::Paper.field(), renewed()];
    for options in restored.into_iter().chain(others()) {
        let expected = fitted(gpu, 300, &options, 14);
        let [source, target] = clouds(300);
        let transform = gpu
            .prepare_target(&source, &target, &options.loss, &Uncontrolled)
            .expect("small clouds fit");
        let mut first = transform.start(&source, &options, 0).expect("a trainer");
        first.advance(5, &Uncontrolled).expect("iterations");
        let state = first.state().expect("an answer").expect("whole");
        drop(first);
        let mut second = transform.start(&source, &options, 0).expect("a trainer");
        second.restore(state).expect("memory");
        second.advance(9, &Uncontrolled).expect("iterations");
        assert!(second.evaluate(&source).expect("an answer") == expected);
    }
}

#[test]
fn a_fit_that_keeps_neighbors_has_no_state_of_its_own() {
    let Some(gpu) = shared() else {
        return;
    };
    let (options, [source, target]) = (renewed(), clouds(300));
    let prepared = gpu
        .prepare_target(&source, &target, &options.loss, &Uncontrolled)
        .expect("small clouds fit");
    let mut trainer = prepared.start(&source, &options, 0).expect("a trainer");
    // After two iterations the third and each third one after it search.
    for (done, whole) in [(2, true), (3, false), (4, false), (5, true)] {
        let steps = done - trainer.report().iterations;
        trainer.advance(steps, &Uncontrolled).expect("iterations");
        let state = trainer.state().expect("an answer");
        assert_eq!(state.is_some(), whole, "after {done} iterations");
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
