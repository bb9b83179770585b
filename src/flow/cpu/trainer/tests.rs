//! Tests of the trainer: against the method in double precision, and for reproducible bits.

use std::sync::Mutex;

use super::*;
use crate::flow::cpu::backend::CpuBackend;
use crate::flow::cpu::mlp::Mlp;
use crate::flow::data::{Random, Uncontrolled};
use crate::flow::distance::{DistanceOptions, DistanceTransform};
use crate::flow::field::{
    Backend, MOST_POINTS, PreparedTarget, ReferenceLoss, chamfer_distance, first_cycle_losses,
    first_losses, mean_distance,
};
use crate::flow::options::{BatchGrowth, FieldOptions, LossOptions, Preset, Renewal};
use crate::flow::simd::Isa;

/// The state of `trainer`.
fn state(trainer: &mut dyn Trainer) -> TrainerState {
    let state = trainer.state().expect("the cpu does not fail");
    state.expect("the state is whole")
}

/// Records the losses.
#[derive(Default)]
struct Losses(Mutex<Vec<f64>>);

impl Control for Losses {
    fn progress(&self, progress: Progress) {
        self.0
            .lock()
            .expect("no test panics in it")
            .push(progress.loss);
    }
}

/// A wall and a box in front of it, and the same cloud moved by a quarter of a metre.
pub(super) fn clouds(points: usize) -> [Vec<Point>; 2] {
    let mut random = Random::new(5);
    let source: Vec<Point> = (0..points)
        .map(|i| {
            let mut across = |width: f64| random.uniform(-width, width) as f32;
            if i % 3 == 0 {
                [4.0, across(1.0), across(1.0)]
            } else {
                [8.0, across(6.0), across(2.0)]
            }
        })
        .collect();
    let target = source
        .iter()
        .map(|p| [p[0] + 0.1, p[1] + 0.2, p[2]])
        .collect();
    [source, target]
}

fn prepared(
    isa: Isa,
    threads: usize,
    source: &[Point],
    target: &[Point],
    options: &FieldOptions,
) -> Box<dyn PreparedTarget> {
    let backend = CpuBackend::with_isa(isa, Some(threads)).expect("threads");
    let mut prepared = backend
        .prepare_target(source, target, &options.loss, &Uncontrolled)
        .expect("small clouds");
    if options.has_cycle() {
        let cycle = prepared.prepare_cycle(source, &Uncontrolled);
        cycle.expect("a small cloud");
    }
    prepared
}

fn fitted(
    isa: Isa,
    threads: usize,
    options: &FieldOptions,
    steps: usize,
) -> (Vec<f64>, Vec<Point>) {
    fitted_from(0, isa, threads, options, steps)
}

fn fitted_from(
    seed: u64,
    isa: Isa,
    threads: usize,
    options: &FieldOptions,
    steps: usize,
) -> (Vec<f64>, Vec<Point>) {
    let [source, target] = clouds(1500);
    let losses = Losses::default();
    let target = prepared(isa, threads, &source, &target, options);
    let mut trainer = target.start(&source, options, seed).expect("a trainer");
    trainer
        .advance(steps, &losses)
        .expect("the cpu does not fail");
    let flow = trainer.evaluate(&source).expect("the cpu does not fail");
    (losses.0.into_inner().expect("no test panics in it"), flow)
}

#[test]
fn the_first_losses_are_those_of_the_method_in_double_precision() {
    // Single against double precision, over ten steps that move every weight by a thousandth each.
    // With longer steps rounding errors grow.
    const TOLERANCE: f64 = 2e-3;
    const STEPS: i32 = 10;
    const RATE: f32 = 1e-3;
    // Rounding grows faster through two networks.
    const CYCLE_RATE: f32 = 2e-4;
    let [source, target] = clouds(200);
    let distance =
        DistanceTransform::build(&source, &target, &DistanceOptions::default(), &Uncontrolled)
            .expect("small clouds");
    let to_distance = mean_distance(&distance);
    let to_cloud = |deformed: &[[f64; 3]]| chamfer_distance(deformed, &target, 2.0);
    let one = |loss: &ReferenceLoss| first_losses(&source, loss, 0, RATE.into(), STEPS);
    let cycle = first_cycle_losses([&source, &target], 2.0, 0, CYCLE_RATE.into(), STEPS);
    let methods = [
        (Preset::Paper, RATE, one(&to_distance)),
        (Preset::NsfpBaseline, RATE, one(&to_cloud)),
        (Preset::NsfpKdtree, RATE, one(&to_cloud)),
        (Preset::Nsfp, CYCLE_RATE, cycle),
    ];
    for (preset, rate, expected) in methods {
        let mut options = preset.field();
        options.learning_rate = rate;
        for isa in Isa::available() {
            let losses = Losses::default();
            let target = prepared(isa, 2, &source, &target, &options);
            let mut trainer = target.start(&source, &options, 0).expect("a trainer");
            trainer
                .advance(STEPS as usize, &losses)
                .expect("the cpu does not fail");
            let losses = losses.0.into_inner().expect("no test panics in it");
            assert_eq!(losses.len(), expected.len(), "{preset:?} {isa:?}");
            for (loss, expected) in losses.iter().zip(&expected) {
                let error = (loss - expected).abs() / expected;
                assert!(
                    error < TOLERANCE,
                    "{preset:?} {isa:?}: {losses:?} {expected:?}"
                );
            }
        }
    }
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    for preset in Preset::with_field() {
        let mut options = preset.field();
        options.batch = options.batch.map(|_| 700);
        let [one, two, five] =
            [1, 2, 5].map(|threads| fitted(Isa::available()[0], threads, &options, 12));
        assert_eq!(one, two, "{preset:?}");
        assert_eq!(one, five, "{preset:?}");
    }
}

#[test]
fn registers_of_any_width_give_the_same_bits_where_they_fuse() {
    // Only meaningful on a machine with both sets, such as one with AVX-512.
    let fusing = Isa::available().into_iter();
    let fusing: Vec<Isa> = fusing.filter(|&isa| isa != Isa::Portable).collect();
    for preset in Preset::with_field() {
        let options = preset.field();
        let all: Vec<_> = fusing
            .iter()
            .map(|&isa| fitted(isa, 2, &options, 30))
            .collect();
        assert!(all.iter().all(|one| *one == all[0]), "{preset:?}");
    }
}

#[test]
fn more_chunks_than_are_held_at_once_are_each_added_up_once() {
    // Relative to the largest gradient: single-precision sums over 8,000 points, one after the
    // other.
    const TOLERANCE: f64 = 1e-4;
    let points = 33 * MOST_POINTS;
    let chunks = Chunks::new(points).count;
    assert!(chunks > Mlp::HELD);
    let [source, target] = clouds(points);
    let mut options = Preset::Paper.field();
    options.early_stop = None;
    let target = prepared(Isa::available()[0], 2, &source, &target, &options);
    let mut trainer = target.start(&source, &options, 0).expect("a trainer");
    trainer
        .advance(1, &Uncontrolled)
        .expect("the cpu does not fail");
    // After one step from zero moments, the mean of the gradients is a tenth of the gradient. That
    // is the sum of the chunks' gradients. A trainer of one chunk's points finds that chunk's
    // gradient, up to the weight of the batch.
    let whole = state(trainer.as_mut()).moments[0].clone();
    let mut sums = vec![0.0f64; whole.as_slice().len()];
    for chunk in 0..chunks {
        let own = Chunks::new(points).points(chunk);
        let own = &source[own.start..own.end.min(points)];
        let mut part = target.start(own, &options, 0).expect("a trainer");
        part.advance(1, &Uncontrolled)
            .expect("the cpu does not fail");
        let state = state(part.as_mut());
        let share = own.len() as f64 / points as f64;
        for (sum, mean) in sums.iter_mut().zip(state.moments[0].as_slice()) {
            *sum += f64::from(*mean) * share;
        }
    }
    let scale = sums.iter().fold(0.0f64, |most, sum| most.max(sum.abs()));
    for (mean, expected) in whole.as_slice().iter().zip(&sums) {
        let off = (f64::from(*mean) - expected).abs() / scale;
        assert!(off < TOLERANCE, "{off}");
    }
}

#[test]
fn seeds_give_different_fields() {
    let options = Preset::Neural.field();
    let seeded = |seed| fitted_from(seed, Isa::Portable, 1, &options, 3);
    assert_ne!(seeded(0), seeded(1));
}

#[test]
fn a_zero_start_is_no_flow() {
    let options = Preset::Neural.field();
    let (_, flow) = fitted(Isa::available()[0], 1, &options, 0);
    assert!(flow.iter().flatten().all(|&f| f == 0.0));
}

#[test]
fn the_best_field_has_the_lowest_loss_and_not_the_last() {
    let mut options = Preset::Paper.field();
    options.early_stop = None;
    // A step size this large overshoots after some iterations.
    options.learning_rate = 0.05;
    let [source, target] = clouds(500);
    let losses = Losses::default();
    let target = prepared(Isa::available()[0], 2, &source, &target, &options);
    let mut trainer = target.start(&source, &options, 0).expect("a trainer");
    trainer.advance(40, &losses).expect("the cpu does not fail");
    let losses = losses.0.into_inner().expect("no test panics in it");
    let lowest = losses.iter().copied().fold(f64::INFINITY, f64::min);
    let report = trainer.report();
    assert_eq!(report.best_loss, lowest);
    assert_eq!(losses[report.best_iteration - 1], lowest);
    assert!(
        report.best_iteration < 40,
        "the last iteration was the best: no overshoot"
    );
}

/// Interrupts at the second question, which is asked within the search of correspondences.
#[derive(Default)]
struct Impatient(core::sync::atomic::AtomicUsize);

impl Control for Impatient {
    fn interrupt(&self) -> Option<Interrupt> {
        let asked = self.0.fetch_add(1, core::sync::atomic::Ordering::Relaxed);
        (asked > 0).then_some(Interrupt::Cancelled)
    }
}

#[test]
fn a_search_of_correspondences_is_interrupted_and_the_iteration_does_not_count() {
    let [source, target] = clouds(3000);
    for preset in [Preset::NsfpBaseline, Preset::NsfpKdtree] {
        let options = preset.field();
        let target = prepared(Isa::available()[0], 2, &source, &target, &options);
        let mut trainer = target.start(&source, &options, 0).expect("a trainer");
        let advance = trainer.advance(5, &Impatient::default());
        let interrupted = Advance::Interrupted(Interrupt::Cancelled);
        assert_eq!(advance.expect("the cpu does not fail"), interrupted);
        assert_eq!(trainer.report().iterations, 0);
    }
}

#[test]
fn a_target_for_one_kind_of_loss_refuses_a_fit_to_another() {
    let [source, target] = clouds(50);
    let (transform, cloud) = (Preset::Paper.field(), Preset::NsfpBaseline.field());
    for (options, other) in [(&transform, &cloud), (&cloud, &transform)] {
        let target = prepared(Isa::Portable, 1, &source, &target, options);
        let refused = target.start(&source, other, 0).err();
        assert!(matches!(refused, Some(BackendError::Unsupported(_))));
    }
}

#[test]
fn the_way_back_of_a_cycle_is_prepared_under_the_control() {
    let [source, target] = clouds(1500);
    let options = Preset::NsfpPlusPlusDt.field();
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let target = backend.prepare_target(&source, &target, &options.loss, &Uncontrolled);
    let mut target = target.expect("a small cloud");
    let unprepared = target.start(&source, &options, 0).err();
    assert!(matches!(unprepared, Some(BackendError::Unsupported(_))));
    let interrupted = target.prepare_cycle(&source, &Impatient::default());
    assert!(matches!(interrupted, Err(BackendError::Interrupted(_))));
    assert!(target.start(&source, &options, 0).is_err());
    target
        .prepare_cycle(&source, &Uncontrolled)
        .expect("a small cloud");
    let mut trainer = target.start(&source, &options, 0).expect("a trainer");
    let advance = trainer.advance(2, &Uncontrolled);
    assert_eq!(advance.expect("the cpu does not fail"), Advance::Continues);
}

#[test]
fn a_fit_with_growing_batches_and_rare_searches_resumes_with_the_same_bits() {
    let mut renewed = Preset::NsfpBaseline.field();
    let LossOptions::Chamfer(loss) = &mut renewed.loss else {
        panic!("a Chamfer distance");
    };
    loss.renewal = Some(Renewal { first: 6, every: 5 });
    let mut grown = Preset::Paper.field();
    let mut both = renewed.clone();
    for options in [&mut grown, &mut both] {
        options.batch = Some(100);
        options.growth = Some(BatchGrowth::LossFall(0.1));
    }
    let [source, target] = clouds(1500);
    for options in [renewed, grown, both] {
        let target = prepared(Isa::available()[0], 2, &source, &target, &options);
        let start = || target.start(&source, &options, 0).expect("a trainer");
        let advance = |trainer: &mut dyn Trainer, steps| {
            let advance = trainer.advance(steps, &Uncontrolled);
            assert_eq!(advance.expect("the cpu does not fail"), Advance::Continues);
        };
        let mut whole = start();
        advance(whole.as_mut(), 17);
        let mut resumed = start();
        let mut stored = 0;
        for done in 1..=17 {
            advance(resumed.as_mut(), 1);
            if let Some(state) = resumed.state().expect("the cpu does not fail") {
                assert_eq!(state.iterations, done);
                resumed = start();
                resumed.restore(state).expect("its own state");
                stored += 1;
            }
        }
        assert!(stored > 5, "{stored} states");
        let whole = whole.evaluate(&source).expect("the cpu does not fail");
        let resumed = resumed.evaluate(&source).expect("the cpu does not fail");
        assert_eq!(whole, resumed);
    }
}

#[test]
fn a_rare_search_keeps_the_neighbors_of_the_last_one() {
    let mut options = Preset::NsfpKdtree.field();
    let mut losses_of = |renewal| {
        let LossOptions::Chamfer(loss) = &mut options.loss else {
            panic!("a Chamfer distance");
        };
        loss.renewal = renewal;
        fitted(Isa::available()[0], 2, &options, 12).0
    };
    let always = losses_of(None);
    let rarely = losses_of(Some(Renewal { first: 4, every: 4 }));
    // The fifth iteration searches, the sixth does not.
    assert_eq!(always[..5], rarely[..5]);
    assert_ne!(always[5..], rarely[5..]);
    assert_eq!(always, losses_of(Some(Renewal { first: 0, every: 1 })));
}

#[test]
fn in_birds_eye_view_the_flow_has_no_z_and_does_not_depend_on_it() {
    for preset in [Preset::Paper, Preset::Nsfp] {
        let mut options = preset.field();
        options.bev = true;
        let [source, target] = clouds(400);
        let [source, target] = [&source, &target].map(|cloud| options.seen(cloud).into_owned());
        let prepared = prepared(Isa::available()[0], 2, &source, &target, &options);
        let mut trainer = prepared.start(&source, &options, 0).expect("a trainer");
        trainer
            .advance(20, &Uncontrolled)
            .expect("the cpu does not fail");
        let flow = trainer.evaluate(&source).expect("the cpu does not fail");
        assert!(flow.iter().all(|flow| flow[2] == 0.0 && flow[0] != 0.0));
        let Ok(FittedField::Network(network)) = trainer.fitted() else {
            panic!("a network");
        };
        let backend = CpuBackend::new(Some(2)).expect("threads");
        let lifted: Vec<Point> = source.iter().map(|&[x, y, _]| [x, y, 3.0]).collect();
        for points in [&source, &lifted] {
            assert_eq!(backend.evaluate(&network, points).expect("flows"), flow);
        }
    }
}
