//! Tests of the estimate: masks, ground, deadlines, cancellation and a given ego motion.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use super::ego_motion::prior;
use super::*;
use crate::flow::cpu::CpuBackend;
use crate::flow::data::Control;
use crate::flow::data::Interrupt;
use crate::flow::data::StopReason;
use crate::flow::data::{Point, Random, RigidTransform};
use crate::flow::data::{Progress, Uncontrolled};
use crate::flow::data::{transform_point, transform_points};
use crate::flow::error::FlowError;
use crate::flow::field::{Backend, BackendError, Network, PreparedTarget};
use crate::flow::host::Host;
use crate::flow::motion::{MotionField, Residual};
use crate::flow::objects::{FoundInScene, PackedScene};
use crate::flow::options::Options;
use crate::flow::options::{Ego, Ground, LossOptions, Preset};
use crate::flow::problem::Problem;
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};

/// Interrupts after a number of iterations, or of clusters.
struct After(usize, Interrupt, AtomicUsize);

impl Control for After {
    fn interrupt(&self) -> Option<Interrupt> {
        (self.2.load(Ordering::Relaxed) >= self.0).then_some(self.1)
    }
    fn progress(&self, progress: Progress) {
        self.2.store(progress.done, Ordering::Relaxed);
    }
}

fn street() -> SimulatedPair {
    let options = StreetOptions {
        beams: 16,
        azimuth_steps: 500,
        ..StreetOptions::default()
    };
    Street::new(&options)
        .and_then(|street| street.pair(0))
        .expect("a small street")
}

fn estimated(
    pair: &SimulatedPair,
    options: &Options,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: Some([&pair.ground_source, &pair.ground_target]),
        times: None,
        before: None,
        neighbors: &[],
    };
    estimate(&backend, &problem, options, control)
}

#[test]
fn points_left_out_keep_their_row_with_zero_flow() {
    let pair = street();
    let mut options = Preset::Neural.options(None);
    options.ground = Ground::Mask;
    options.crop_m = Some(30.0);
    let estimate = estimated(&pair, &options, &Uncontrolled).expect("a flow");
    assert_eq!(estimate.flow.len(), pair.source.len());
    for (row, point) in pair.source.iter().enumerate() {
        let kept = !pair.ground_source[row] && point[0].abs() <= 30.0 && point[1].abs() <= 30.0;
        assert_eq!(estimate.valid[row], kept, "row {row}");
        assert!(kept || estimate.flow[row] == [0.0; 3], "row {row}");
    }
    assert_eq!(
        estimate.points,
        estimate.valid.iter().filter(|&&v| v).count()
    );
}

#[test]
fn ground_that_is_found_moves_with_the_vehicle_and_takes_no_part() {
    let pair = street();
    let mut options = Preset::Neural.options(None);
    let estimated = |options: &Options| {
        let backend = CpuBackend::new(Some(2)).expect("threads");
        let problem = Problem::pair(&pair.source, &pair.target);
        estimate(&backend, &problem, options, &Uncontrolled).expect("a flow")
    };
    let estimate = estimated(&options);
    let ego = estimate.ego.expect("it is estimated");
    assert!(estimate.valid.iter().all(|&valid| valid));
    assert!(estimate.points < pair.source.len());
    let found = crate::flow::ground::segment(&pair.source, &Default::default()).ground;
    let dynamic = estimate.dynamic.expect("the ego motion is known");
    for (row, point) in pair
        .source
        .iter()
        .enumerate()
        .filter(|&(row, _)| found[row])
    {
        let to = transform_point(&ego, *point);
        let expected: Point = core::array::from_fn(|a| to[a] - point[a]);
        assert_eq!(estimate.flow[row], expected, "row {row}");
        assert!(!dynamic[row], "row {row}");
    }
    // Ground is invalid without an ego motion, or where points are sampled.
    for (ego, max_points) in [(Ego::Off, None), (Ego::Auto, Some(500))] {
        options.ego = ego;
        options.max_points = max_points;
        let estimate = estimated(&options);
        assert!((0..found.len()).all(|row| !found[row] || !estimate.valid[row]));
    }
}

#[test]
fn a_deadline_gives_the_best_flow_so_far_and_a_cancellation_gives_none() {
    let pair = street();
    for preset in Preset::with_field() {
        let options = preset.options(None);
        let deadline = After(3, Interrupt::Deadline, AtomicUsize::new(0));
        let estimate = estimated(&pair, &options, &deadline).expect("a flow");
        assert_eq!(estimate.stop_reason, StopReason::Deadline);
        let iterations = estimate.fit().expect("a fit").iterations;
        let field = options.field().expect("a field");
        if field.partition.is_some() {
            // Progress counts clusters.
            assert!(iterations > 3, "{preset:?}: {iterations}");
        } else {
            // A search of correspondences asks more often than once in an iteration.
            let fewer = field.loss.distance().is_none() && iterations < 3;
            assert!(iterations == 3 || fewer, "{preset:?}: {iterations}");
        }
        assert!(estimate.flow.iter().flatten().all(|f| f.is_finite()));
        let cancel = After(3, Interrupt::Cancelled, AtomicUsize::new(0));
        let error = estimated(&pair, &options, &cancel).expect_err("cancelled");
        assert!(matches!(error, FlowError::Cancelled));
    }
}

#[test]
fn a_deadline_before_the_first_iteration_still_gives_a_flow() {
    let now = After(0, Interrupt::Deadline, AtomicUsize::new(0));
    let estimate = estimated(&street(), &Preset::Neural.options(None), &now).expect("a flow");
    assert_eq!(estimate.fit().expect("a fit").iterations, 0);
    assert!(estimate.flow.iter().flatten().all(|f| f.is_finite()));
}

#[test]
fn an_evaluation_that_comes_too_late_is_told() {
    /// Late after the last iteration.
    struct LateAtTheEnd(AtomicBool);
    impl Control for LateAtTheEnd {
        fn seconds_left(&self) -> Option<f64> {
            let is_late = self.0.load(Ordering::Relaxed);
            Some(if is_late { 0.0 } else { 1e6 })
        }
        fn progress(&self, progress: Progress) {
            self.0
                .store(progress.done == progress.total, Ordering::Relaxed);
        }
    }
    let mut options = Preset::Neural.options(None);
    options.field_mut().expect("a field").max_iterations = 5;
    let free = estimated(&street(), &options, &Uncontrolled).expect("a flow");
    assert_eq!(free.stop_reason, StopReason::MaxIterations);
    let late = LateAtTheEnd(AtomicBool::new(false));
    let late = estimated(&street(), &options, &late).expect("a flow");
    assert!(late.flow != free.flow);
    assert_eq!(late.stop_reason, StopReason::Deadline);
}

/// A device that has no memory for cells below a size, metres. Counts the refusals, and keeps the source
/// that its last target was prepared for.
struct Scarce {
    cpu: CpuBackend,
    least_cell_m: f64,
    refused: AtomicUsize,
    source: Mutex<Vec<Point>>,
}

impl Scarce {
    fn new(least_cell_m: f64) -> Self {
        Self {
            cpu: CpuBackend::new(Some(2)).expect("threads"),
            least_cell_m,
            refused: AtomicUsize::new(0),
            source: Mutex::default(),
        }
    }
}

impl Backend for Scarce {
    fn name(&self) -> String {
        "a device with little memory".to_owned()
    }

    fn host(&self) -> &Host {
        self.cpu.host()
    }

    fn searches_clusters(&self) -> bool {
        true
    }

    fn search_clusters(
        &self,
        _: &PackedScene,
        _: &dyn Fn() -> bool,
    ) -> Result<FoundInScene, BackendError> {
        self.refused.fetch_add(1, Ordering::Relaxed);
        Err(BackendError::Busy)
    }

    fn prepare_target(
        &self,
        source: &[Point],
        target: &[Point],
        options: &LossOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn PreparedTarget>, BackendError> {
        let distance = options.distance().expect("a distance transform");
        if distance.transform.cell_m < self.least_cell_m {
            return Err(match self.refused.fetch_add(1, Ordering::Relaxed) {
                0 => BackendError::Busy,
                _ => BackendError::Memory {
                    what: "distance transform",
                    needed: 2,
                    available: 1,
                },
            });
        }
        *self.source.lock().expect("no panic") = source.to_vec();
        self.cpu.prepare_target(source, target, options, control)
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        self.cpu.evaluate(network, points)
    }
}

#[test]
fn a_finer_transform_that_the_device_cannot_hold_leaves_the_coarse_one() {
    /// A tenth of a second is left, on a clock that stands still.
    struct Tight;
    impl Control for Tight {
        fn seconds_left(&self) -> Option<f64> {
            Some(0.1)
        }
    }
    let pair = street();
    let mut options = Preset::Neural.options(None);
    let field = options.field_mut().expect("a field");
    field.max_iterations = 3;
    let cell_m = field
        .loss
        .distance()
        .expect("a distance transform")
        .transform
        .cell_m;
    let backend = Scarce::new(3.0 * cell_m);
    let problem = Problem::pair(&pair.source, &pair.target);
    let estimate = estimate(&backend, &problem, &options, &Tight).expect("a flow");
    assert_eq!(
        backend.refused.load(Ordering::Relaxed),
        2,
        "both finer ones were tried"
    );
    assert!(estimate.fit().expect("a fit").iterations > 0);
    assert!(estimate.flow.iter().flatten().all(|f| f.is_finite()));
}

#[test]
fn a_cycle_is_prepared_for_the_source_in_the_frame_of_the_target() {
    let pair = street();
    let motion = pair.target_from_source;
    for cycle in [false, true] {
        let mut options = Preset::Neural.options(None);
        (options.ground, options.ego) = (Ground::Keep, Ego::Given(motion));
        let field = options.field_mut().expect("a field");
        field.max_iterations = 0;
        field.network_mut().expect("a network").cycle = cycle;
        let backend = Scarce::new(0.0);
        let problem = Problem::pair(&pair.source, &pair.target);
        estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
        let expected = match cycle {
            true => transform_points(&motion, &pair.source),
            false => pair.source.clone(),
        };
        let source = backend.source.into_inner().expect("no panic");
        assert!(source == expected, "cycle {cycle}");
    }
}

#[test]
fn a_given_ego_motion_is_taken_as_it_is_and_marks_what_moves_against_it() {
    let pair = street();
    let mut options = Preset::Neural.options(None);
    options.ego = Ego::Given(pair.target_from_source);
    options.field_mut().expect("a field").max_iterations = 0;
    let estimate = estimated(&pair, &options, &Uncontrolled).expect("a flow");
    assert_eq!(estimate.ego, Some(pair.target_from_source));
    assert!(
        estimate
            .dynamic
            .is_some_and(|dynamic| dynamic.iter().all(|&moves| !moves))
    );
    for (row, &point) in pair.source.iter().enumerate() {
        let to = transform_point(&pair.target_from_source, point);
        let expected: Point = core::array::from_fn(|a| to[a] - point[a]);
        assert_eq!(estimate.flow[row], expected);
    }
}

#[test]
fn identical_sweeps_are_noticed_though_some_of_their_points_are_no_numbers() {
    let pair = street();
    let mut sweep = pair.source.clone();
    sweep[7] = [f32::NAN; 3];
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem::pair(&sweep, &sweep);
    let options = Preset::Default.options(None);
    let found = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
    assert!(found.same_sweep);
}

#[test]
fn ground_that_is_kept_is_no_overlap_of_two_scenes() {
    let other = StreetOptions {
        beams: 16,
        azimuth_steps: 500,
        seed: 1,
        ..StreetOptions::default()
    };
    let other = Street::new(&other).and_then(|street| street.pair(0));
    let (pair, other) = (street(), other.expect("a small street"));
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem::pair(&pair.source, &other.target);
    let overlaps = [Ground::Auto, Ground::Keep].map(|ground| {
        let mut options = Preset::Default.options(None);
        options.ground = ground;
        match estimate(&backend, &problem, &options, &Uncontrolled) {
            Err(FlowError::NoOverlap { overlap }) => overlap,
            other => panic!("{ground:?}: {:?}", other.map(|found| found.overlap)),
        }
    });
    assert_eq!(overlaps[0], overlaps[1]);
}

#[test]
fn a_device_without_memory_leaves_the_clusters_to_the_host() {
    let pair = street();
    let problem = Problem::pair(&pair.source, &pair.target);
    let options = Preset::Default.options(None);
    let device = Scarce::new(0.0);
    let [of_device, of_host] = [&device as &dyn Backend, &device.cpu]
        .map(|backend| estimate(backend, &problem, &options, &Uncontrolled).expect("a flow"));
    assert_eq!(device.refused.load(Ordering::Relaxed), 1);
    assert_eq!(of_device.device, device.cpu.host().name());
    assert_eq!(of_device.flow, of_host.flow);
    assert_eq!(of_device.objects(), of_host.objects());
}

#[test]
fn nothing_is_certain_where_a_deadline_cuts_the_registration_short() {
    let pair = street();
    let problem = Problem::pair(&pair.source, &pair.target);
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let options = Preset::Default.options(None);
    let late = After(0, Interrupt::Deadline, AtomicUsize::new(0));
    let found = estimate(&backend, &problem, &options, &late).expect("a flow");
    assert_eq!(found.stop_reason, StopReason::Deadline);
    assert_eq!((found.ego, found.ego_is_rough), (None, true));
    let objects = found.objects().expect("objects");
    let all = objects.confidence.iter().chain(&objects.moving);
    assert!(all.copied().all(|probability| probability == 0.0));
    let found = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
    assert!(!found.ego_is_rough && found.ego_covariance.is_some());
}

#[test]
fn a_tower_of_points_takes_no_longer_than_others() {
    // Every point would be compared with all others: 4e10 distances, several times.
    let mut random = Random::new(3);
    let mut point = || [0.7, 0.7, 1500.0].map(|side| random.uniform(0.0, side) as f32);
    let tower: Vec<Point> = (0..200_000).map(|_| point()).collect();
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem::pair(&tower, &tower);
    let options = Preset::Default.options(None);
    let found = estimate(&backend, &problem, &options, &Uncontrolled).expect("a flow");
    assert_eq!(found.flow.len(), tower.len());
}

#[test]
fn only_a_warm_start_begins_with_the_ego_motion_of_the_pair_before() {
    let motion = RigidTransform::translation(-1.0, 0.0, 0.0);
    let before = MotionField {
        ego: Some(motion),
        residual: Residual::Still,
    };
    let problem = Problem {
        before: Some(&before),
        ..Problem::pair(&[], &[])
    };
    let of = |preset: Preset| prior(&problem, &preset.options(None));
    assert_eq!(of(Preset::Neural), motion);
    assert_eq!(of(Preset::Default), RigidTransform::identity());
    assert_eq!(of(Preset::Paper), RigidTransform::identity());
}
