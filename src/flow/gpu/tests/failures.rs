//! Refused requests and a lost GPU.

use std::sync::atomic::{AtomicUsize, Ordering};

use super::{clouds, opened, shared};
use crate::flow::data::{Control, Interrupt, Point, Progress, Uncontrolled};
use crate::flow::distance::{DistanceOptions, Metric, Sites};
use crate::flow::error::FlowError;
use crate::flow::estimate::estimate;
use crate::flow::field::{Advance, Backend, BackendError};
use crate::flow::gpu::adapter::{Selector, select};
use crate::flow::gpu::backend::Gpu;
use crate::flow::gpu::memory::GpuOptions;
use crate::flow::options::{
    BatchGrowth, DistanceLossOptions, FieldOptions, LinearOptions, LossOptions, ModelOptions,
    Preset,
};
use crate::flow::problem::Problem;

/// Destroys the device after some iterations.
struct Kill<'a>(&'a Gpu, AtomicUsize);

impl Control for Kill<'_> {
    fn progress(&self, _: Progress) {
        if self.1.fetch_add(1, Ordering::Relaxed) == 4 {
            self.0.destroy();
        }
    }
}

#[test]
fn a_card_lost_in_the_middle_of_a_run_fails_the_run_and_can_be_opened_again() {
    let Some(gpu) = opened(&GpuOptions::default()) else {
        return;
    };
    let [source, target] = clouds(500);
    let problem = Problem::pair(&source, &target);
    let mut options = Preset::Neural.options(None);
    options.field_mut().expect("a field").max_iterations = 20;
    let killed = estimate(&gpu, &problem, &options, &Kill(&gpu, AtomicUsize::new(0)));
    assert!(
        matches!(killed, Err(FlowError::Backend(BackendError::Lost(_)))),
        "{:?}",
        killed.err()
    );
    assert!(gpu.is_lost());
    let later = estimate(&gpu, &problem, &options, &Uncontrolled);
    assert!(matches!(
        later,
        Err(FlowError::Backend(BackendError::Lost(_)))
    ));
    drop(gpu);
    let again = opened(&GpuOptions::default()).expect("it was there before");
    estimate(&again, &problem, &options, &Uncontrolled).expect("a flow");
}

#[test]
fn a_pair_that_never_fits_is_refused_before_it_takes_anything() {
    let Some(gpu) = shared() else {
        return;
    };
    // Points 8 m apart: each of them activates hundreds of bricks.
    let cloud: Vec<Point> = (0..40u8)
        .flat_map(|x| (0..40u8).map(move |y| [x, y]))
        .flat_map(|[x, y]| (0..4u8).map(move |z| [x, y, z].map(|c| f32::from(c) * 8.0)))
        .collect();
    let refused = gpu.prepare_target(&cloud, &cloud, &Preset::Paper.field().loss, &Uncontrolled);
    match refused.err() {
        Some(BackendError::Memory {
            needed, available, ..
        }) => assert!(needed > available),
        // A large GPU has enough memory.
        None => assert!(gpu.memory_bytes() > 1 << 30),
        Some(error) => panic!("{error}"),
    }
}

#[test]
fn what_only_the_cpu_computes_is_refused_by_name() {
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(100);
    let distance = |metric: Metric, sites: Sites| {
        LossOptions::Distance(DistanceLossOptions {
            transform: DistanceOptions {
                metric,
                sites,
                ..DistanceOptions::default()
            },
            ..DistanceLossOptions::published()
        })
    };
    for loss in [
        distance(Metric::Chamfer, Sites::Cells),
        distance(Metric::Euclidean, Sites::Points),
        Preset::NsfpKdtree.field().loss,
    ] {
        let refused = gpu.prepare_target(&source, &target, &loss, &Uncontrolled);
        assert!(matches!(
            refused.err(),
            Some(BackendError::Unsupported(text)) if text.contains("CPU")
        ));
    }
    let usual = Preset::Paper.field();
    let mut cycle = usual.clone();
    cycle.network_mut().expect("a network").cycle = true;
    let consistency = FieldOptions {
        consistency_weight: 0.1,
        ..usual.clone()
    };
    let growth = FieldOptions {
        growth: Some(BatchGrowth::Iterations(5)),
        ..usual.clone()
    };
    let bev = FieldOptions {
        bev: true,
        ..usual.clone()
    };
    let prepared = gpu.prepare_target(&source, &target, &usual.loss, &Uncontrolled);
    let prepared = prepared.expect("small clouds fit");
    for options in [cycle, consistency, growth, bev] {
        assert!(!options.runs_on_gpu());
        let refused = prepared.start(&source, &options, 0);
        assert!(matches!(
            refused.err(),
            Some(BackendError::Unsupported(text)) if text.contains("CPU")
        ));
    }
}

#[test]
fn a_grid_that_the_card_cannot_bind_is_refused_with_what_it_would_take() {
    // 100 x 300 x 100 vertices: five arrays of three floats each are 180 MB.
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(100);
    let mut options = Preset::FnsfLinear.field();
    options.model = ModelOptions::Linear(LinearOptions {
        voxel_m: 0.04,
        sigma_m: 0.1,
        ..LinearOptions::published()
    });
    let prepared = gpu.prepare_target(&source, &target, &options.loss, &Uncontrolled);
    let prepared = prepared.expect("small clouds fit");
    let limits = gpu.device().context.device.limits();
    let limit = limits.max_storage_buffer_binding_size;
    match prepared.start(&source, &options, 0).err() {
        Some(BackendError::Memory { needed, .. }) => assert!(needed > limit),
        None => assert!(limit > 100 << 20),
        Some(error) => panic!("{error}"),
    }
}

#[test]
fn more_pairs_than_lanes_are_told_to_come_back() {
    let Some(gpu) = opened(&GpuOptions::default()) else {
        return;
    };
    let [source, target] = clouds(100);
    let options = Preset::Paper.field();
    let transform = gpu
        .prepare_target(&source, &target, &options.loss, &Uncontrolled)
        .expect("small clouds fit");
    let first = transform.start(&source, &options, 0).expect("a trainer");
    let second = transform.start(&source, &options, 0);
    assert!(matches!(second.err(), Some(BackendError::Busy)));
    drop(first);
    transform.start(&source, &options, 0).expect("a trainer");
}

#[test]
fn a_run_that_diverges_says_so() {
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(100);
    let mut options = Preset::Paper.field();
    options.learning_rate = f32::INFINITY;
    let transform = gpu
        .prepare_target(&source, &target, &options.loss, &Uncontrolled)
        .expect("small clouds fit");
    let mut trainer = transform.start(&source, &options, 0).expect("a trainer");
    let ended = trainer.advance(5, &Uncontrolled).expect("an answer");
    assert_eq!(ended, Advance::Diverged);
}

#[test]
fn an_interrupted_run_stops_between_submissions() {
    struct Now;
    impl Control for Now {
        fn interrupt(&self) -> Option<Interrupt> {
            Some(Interrupt::Cancelled)
        }
    }
    let Some(gpu) = shared() else {
        return;
    };
    let [source, target] = clouds(100);
    let options = Preset::Paper.field();
    let transform = gpu
        .prepare_target(&source, &target, &options.loss, &Uncontrolled)
        .expect("small clouds fit");
    let mut trainer = transform.start(&source, &options, 0).expect("a trainer");
    let ended = trainer.advance(5, &Now).expect("an answer");
    assert_eq!(ended, Advance::Interrupted(Interrupt::Cancelled));
    assert_eq!(trainer.report().iterations, 0);
}

#[test]
fn a_card_that_is_not_there_is_named() {
    let missing = select(&Selector::Named("no such card".to_owned()), true);
    let text = missing.map(|_| ()).expect_err("there is none").to_string();
    assert!(text.contains("gpu:no such card"), "{text}");
}
