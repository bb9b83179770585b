//! Tests of pairs that are refused as nonsense: sweeps of two scenes, and coordinates that are not
//! metres. `benches/accuracy/overlap.rs` prints the measured overlaps.

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{
    CERTAIN_OVERLAP, Ego, Estimate, FlowError, LEAST_OVERLAP, Options, Point, Preset, Problem,
    RigidTransform, Uncontrolled, estimate,
};
use nalgebra::Vector3;

use super::scenes::real_pair;

fn street(seed: u64) -> StreetOptions {
    StreetOptions {
        seed,
        azimuth_steps: 900,
        sweeps: 6,
        ..StreetOptions::default()
    }
}

fn sweep(options: &StreetOptions, index: usize) -> Vec<Point> {
    let street = Street::new(options).expect("a street");
    street.sweep(index).expect("a sweep").points
}

fn solved(source: &[Point], target: &[Point], options: &Options) -> Result<Estimate, FlowError> {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem::pair(source, target);
    estimate(&backend, &problem, options, &Uncontrolled)
}

#[test]
fn sweeps_of_two_scenes_are_refused_by_every_preset_with_an_ego_motion() {
    let [source, target] = [1, 2].map(|seed| sweep(&street(seed), 0));
    for preset in [Preset::Default, Preset::Neural, Preset::NsfpPlusPlus] {
        for max_points in [None, Some(2000)] {
            let options = preset.options(max_points);
            match solved(&source, &target, &options) {
                Err(FlowError::NoOverlap { overlap }) => assert!(overlap < 0.25, "{overlap}"),
                other => panic!("{}: {:?}", preset.name(), other.map(|e| e.overlap)),
            }
        }
    }
}

#[test]
fn a_forced_pair_of_two_scenes_has_a_flow_without_confidence() {
    let [source, target] = [1, 2].map(|seed| sweep(&street(seed), 0));
    let options = Options {
        force: true,
        ..Preset::Default.options(None)
    };
    let estimate = solved(&source, &target, &options).expect("a flow");
    assert!(estimate.overlap.expect("large clouds") < LEAST_OVERLAP);
    let objects = estimate.objects().expect("objects");
    assert!(
        objects
            .confidence
            .iter()
            .all(|&confidence| confidence == 0.0)
    );
    assert!(
        objects
            .clusters
            .iter()
            .all(|cluster| cluster.confidence == 0.0)
    );
}

#[test]
fn sweeps_of_one_scene_overlap_half_a_second_apart_and_with_few_beams() {
    for (beams, later) in [(64, 1), (64, 5), (32, 5), (16, 1)] {
        let options = StreetOptions { beams, ..street(3) };
        let [source, target] = [0, later].map(|index| sweep(&options, index));
        let estimate = solved(&source, &target, &Preset::Default.options(None)).expect("a flow");
        let overlap = estimate.overlap.expect("large clouds");
        assert!(overlap >= CERTAIN_OVERLAP, "{beams} beams: {overlap}");
    }
}

#[test]
fn real_sweeps_of_two_scenes_are_refused_in_both_orders() {
    let names = ["av2_7fab", "kitti_0000", "small_gicp"];
    let pairs: Vec<_> = names.iter().filter_map(|name| real_pair(name)).collect();
    for (i, first) in pairs.iter().enumerate() {
        for (j, second) in pairs.iter().enumerate() {
            let options = Preset::Default.options(None);
            let solved = solved(&first.source, &second.target, &options);
            let is_refused = matches!(solved, Err(FlowError::NoOverlap { .. }));
            assert_eq!(is_refused, i != j, "{} to {}", names[i], names[j]);
        }
    }
}

#[test]
fn a_given_motion_that_does_not_align_the_sweeps_is_refused() {
    let [source, target] = [0, 1].map(|index| sweep(&street(4), index));
    let turned = RigidTransform::rotation(Vector3::new(0.0, 0.0, 1.5));
    let given = |motion: RigidTransform| Options {
        ego: Ego::Given(motion),
        ..Preset::Default.options(None)
    };
    let refused = solved(&source, &target, &given(turned));
    assert!(matches!(refused, Err(FlowError::NoOverlap { .. })));
    let street = Street::new(&street(4)).expect("a street");
    let truth = street.pose(1.0).inv_mul(&street.pose(0.0));
    solved(&source, &target, &given(truth)).expect("a flow");
}

#[test]
fn without_an_ego_motion_the_overlap_is_reported_and_nothing_is_refused() {
    let [source, target] = [1, 2].map(|seed| sweep(&street(seed), 0));
    let mut options = Preset::Paper.options(Some(500));
    options.field_mut().expect("a field").max_iterations = 1;
    let estimate = solved(&source, &target, &options).expect("a flow");
    assert!(estimate.overlap.expect("large clouds") < LEAST_OVERLAP);
}

#[test]
fn coordinates_in_millimetres_are_refused_by_name() {
    let [source, target] = [0, 1].map(|index| sweep(&street(5), index));
    let millimetres = |points: &[Point]| -> Vec<Point> {
        let scaled = points.iter().map(|point| point.map(|c| c * 1000.0));
        scaled.collect()
    };
    let [large_source, large_target] = [&source, &target].map(|points| millimetres(points));
    for (source, target, cloud) in [
        (&large_source, &large_target, "source"),
        (&source, &large_target, "target"),
    ] {
        let options = Preset::Paper.options(Some(500));
        let error = solved(source, target, &options).expect_err("millimetres");
        assert!(
            matches!(error, FlowError::NotMetres { cloud: named, .. } if named == cloud),
            "{error}"
        );
        assert!(error.to_string().contains("millimetres"), "{error}");
    }
}

#[test]
fn points_nearer_than_the_least_range_get_no_flow() {
    let [source, target] = [0, 1].map(|index| sweep(&street(6), index));
    let options = Options {
        min_range_m: Some(8.0),
        ..Preset::Default.options(None)
    };
    let estimate = solved(&source, &target, &options).expect("a flow");
    for (&[x, y, _], &valid) in source.iter().zip(&estimate.valid) {
        assert_eq!(valid, x.hypot(y) >= 8.0);
    }
}

#[test]
fn two_equal_sweeps_are_named() {
    let source = sweep(&street(7), 0);
    let options = Preset::Default.options(None);
    let estimate = solved(&source, &source.clone(), &options).expect("a flow");
    assert!(estimate.same_sweep);
    assert_eq!(estimate.overlap, Some(1.0));
}
