//! The search of clusters on a GPU: parts of scenes in one submission, and the normals.

use std::sync::Mutex;

use nalgebra::{Matrix3, Vector3};

use super::*;
use crate::flow::data::{AlignedSweep, Point, RigidTransform, Uncontrolled, locked};
use crate::flow::field::Backend;
use crate::flow::gpu::tests::shared;
use crate::flow::host::Host;
use crate::flow::objects::SearchClouds;
use crate::flow::options::ObjectOptions;
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};

/// The scene of a small street, with the source as the sweep before it.
fn street(seed: u64) -> PackedScene {
    let options = StreetOptions {
        seed,
        beams: 16,
        azimuth_steps: 400,
        ..StreetOptions::default()
    };
    let pair = Street::new(&options).and_then(|street| street.pair(0));
    let SimulatedPair { source, target, .. } = pair.expect("a street");
    let before = source.clone();
    packed(&source, &target, before)
}

/// The scene of a source, a target and the sweep before the source.
fn packed(source: &[Point], target: &[Point], before: Vec<Point>) -> PackedScene {
    let neighbors = [AlignedSweep {
        points: before,
        at: -1,
    }];
    let clouds = SearchClouds {
        source,
        target,
        neighbors: &neighbors,
        sweeps: [source, target],
        times: None,
        target_from_source: RigidTransform::identity(),
    };
    let taken = Mutex::new(None);
    let take = |scene: &PackedScene, _: &dyn Fn() -> bool| {
        *locked(&taken) = Some(scene.clone());
        Err(BackendError::Busy)
    };
    let host = Host::new(Some(2), None).expect("threads");
    let options = ObjectOptions::default();
    let stopped = host.find_objects_with(&clouds, &options, Some(&take), &Uncontrolled);
    assert!(matches!(stopped, Err(BackendError::Busy)));
    locked(&taken).take().expect("a scene")
}

#[test]
fn parts_of_scenes_in_one_submission_have_the_bits_of_each_alone() {
    let Some(gpu) = shared() else {
        return;
    };
    let device = gpu.device();
    let scenes = [street(3), street(4)];
    let found = |scene| gpu.search_clusters(scene, &|| false);
    let alone = scenes
        .each_ref()
        .map(|scene| found(scene).expect("no error"));
    let [first, second] = alone.each_ref().map(|found| found.clusters.len());
    assert!(first > 4 && second > 4, "{first} and {second} clusters");
    let mut records = alone.iter().flat_map(|found| &found.clusters);
    assert!(records.any(|record| record.is_found == 1));
    let kernels = device.cluster_searches.kernels(&device.context);
    let search = Search {
        context: &device.context,
        kernels: kernels.expect("kernels"),
        at_once: first + second,
    };
    let uploaded = scenes
        .each_ref()
        .map(|scene| search.uploaded(scene).expect("memory"));
    let parts = [
        uploaded[1].part(0, 3),
        uploaded[0].part(0, first),
        uploaded[1].part(3, second - 3),
    ];
    let mut waiting: Vec<Ticketed<ScenePart>> = (0..).zip(parts).collect();
    let taken = search.take(&mut waiting);
    assert!(waiting.is_empty());
    let parts: Vec<&ScenePart> = taken.iter().map(|(_, part)| part).collect();
    let found = search.submit(&parts).expect("no error");
    let [begin, whole, end] = &found[..] else {
        panic!("one result for each part")
    };
    assert_eq!(whole.clusters, alone[0].clusters);
    assert_eq!(whole.normals, alone[0].normals);
    assert_eq!(begin.clusters, alone[1].clusters[..3]);
    assert_eq!(begin.normals, alone[1].normals);
    assert_eq!(end.clusters, alone[1].clusters[3..]);
    assert!(end.normals.is_empty());
    // What does not fit is left for the next submission.
    let search = Search {
        at_once: first,
        ..search
    };
    let mut waiting: Vec<_> = [&uploaded[0], &uploaded[1]]
        .map(|scene| (0, scene.part(0, 3)))
        .into();
    waiting.push((1, uploaded[0].part(0, first)));
    assert_eq!(search.take(&mut waiting).len(), 2);
    assert_eq!(waiting.len(), 1);
}

#[test]
fn nothing_is_found_in_sweeps_without_points() {
    let Some(gpu) = shared() else {
        return;
    };
    let points = (0..400_u16).map(|i| [f32::from(i % 20) * 0.1, f32::from(i / 20) * 0.1, 1.0]);
    let scene = packed(&points.collect::<Vec<_>>(), &[], Vec::new());
    let found = gpu.search_clusters(&scene, &|| false).expect("no error");
    assert_eq!((found.clusters.len(), found.clusters[0].is_found), (1, 0));
    assert!(found.normals.is_empty());
}

#[test]
fn a_search_that_is_over_before_it_begins_finds_the_normals_alone() {
    let Some(gpu) = shared() else {
        return;
    };
    let scene = street(3);
    let found = |over: bool| gpu.search_clusters(&scene, &|| over);
    let [nothing, all] = [true, false].map(|over| found(over).expect("no error"));
    assert!(nothing.clusters.is_empty());
    assert!(!nothing.normals.is_empty());
    assert_eq!(nothing.normals, all.normals);
}

/// The normal of the plane of the points less than `within_m` metres from `center`, with a length
/// of 0 if there is no plane. None if rounding decides.
fn plane_normal(
    points: &[Vector3<f64>],
    center: &Vector3<f64>,
    within_m: f64,
) -> Option<Vector3<f64>> {
    const FLAT: f64 = 0.05;
    const ROUNDED_M: f64 = 1e-5;
    const ROUNDED: f64 = 1e-3;
    let away = points.iter().map(|point| point - center);
    if (away.clone()).any(|away| (away.norm() - within_m).abs() < ROUNDED_M) {
        return None;
    }
    let near: Vec<Vector3<f64>> = away.filter(|away| away.norm() < within_m).collect();
    if near.len() < 4 {
        return Some(Vector3::zeros());
    }
    let mean = near.iter().sum::<Vector3<f64>>() / near.len() as f64;
    let squares = near.iter().map(|away| away - mean);
    let squares: Matrix3<f64> = squares.map(|away| away * away.transpose()).sum();
    let eigen = squares.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let [least, middle, most] = order.map(|axis| eigen.eigenvalues[axis]);
    let flatness = (middle - least) / most - FLAT;
    (flatness.abs() > ROUNDED).then(|| match flatness > 0.0 {
        true => eigen.eigenvectors.column(order[0]).into(),
        false => Vector3::zeros(),
    })
}

#[test]
fn normals_are_those_of_planes_that_are_fitted_in_double_precision() {
    /// Cosine of an angle of a tenth of a degree.
    const SAME: f64 = 0.999_998_5;
    let Some(gpu) = shared() else {
        return;
    };
    let scene = street(3);
    let found = gpu.search_clusters(&scene, &|| false);
    let normals = found.expect("no error").normals;
    assert_eq!(scene.views.len(), 2);
    assert!(scene.views.iter().all(|view| view.taken.count > 0));
    let options = ObjectOptions::default();
    let [base, slope] = options.normal_m.map(f64::from);
    let double = |[x, y, z, _]: &[f32; 4]| Vector3::from([x, y, z].map(|&c| f64::from(c)));
    let (mut flat, mut clear) = (0, 0);
    for view in &scene.views {
        let count = (view.free.count + view.taken.count) as usize;
        let points = scene.points[view.targets as usize..][..count].iter();
        let points: Vec<Vector3<f64>> = points.map(double).collect();
        let normals = &normals[view.normals as usize..][..count];
        for (center, normal) in points.iter().zip(normals) {
            let within_m = base + slope * center.xy().norm();
            let within_m = within_m.min(f64::from(options.match_m));
            let Some(expected) = plane_normal(&points, center, within_m) else {
                continue;
            };
            let normal = double(normal);
            assert_eq!(normal == Vector3::zeros(), expected == Vector3::zeros());
            if normal != Vector3::zeros() {
                let along = expected.dot(&normal).abs();
                assert!(along > SAME, "{along} at {center}");
                flat += 1;
            }
            clear += 1;
        }
    }
    assert!(flat > normals.len() / 6, "{flat} of {}", normals.len());
    assert!(
        clear > normals.len() / 20 * 19,
        "{clear} of {}",
        normals.len()
    );
}
