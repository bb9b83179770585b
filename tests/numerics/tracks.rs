//! Tests of tracks: on simulated streets, and on a real drive with tracked boxes.

use std::collections::BTreeSet;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{TrackingMetrics, TrackingPool, tracked_sweeps};
use fnsf::flow::simulate::{SWEEP_SECONDS, Street, StreetOptions, StreetSweep};
use fnsf::flow::tracks::{ClusteredSweep, Track, TrackError, Tracker};
use fnsf::flow::{
    Ego, Estimate, Options, Point, Preset, Problem, Sequence, Sweep, Uncontrolled, estimate,
};
use fnsf::formats::read_cloud;

use super::real_data::real_data;

const SWEEPS: usize = 12;

fn street() -> (Street, Vec<StreetSweep>) {
    let street = Street::new(&StreetOptions {
        seed: 3,
        sweeps: SWEEPS,
        beams: 32,
        ..StreetOptions::default()
    });
    let street = street.expect("a street");
    let sweep = |index| street.sweep(index).expect("a sweep");
    let sweeps = (0..SWEEPS).map(sweep).collect();
    (street, sweeps)
}

/// The estimates of all pairs of `sweeps` by the preset `default`.
fn estimates(sweeps: &[Vec<Point>]) -> Vec<Estimate> {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let options = Preset::Default.options(None);
    let mut sequence = Sequence::default();
    let push = |points: &Vec<Point>| {
        let sweep = Sweep {
            points: points.clone(),
            ground: None,
            ..Sweep::default()
        };
        sequence
            .push(&backend, sweep, &options, &Uncontrolled)
            .expect("a pair")
    };
    sweeps.iter().flat_map(push).collect()
}

fn tracks(sweeps: &[Vec<Point>]) -> Vec<Track> {
    let mut tracker = Tracker::default();
    for (points, estimate) in sweeps.iter().zip(&estimates(sweeps)) {
        let sweep = ClusteredSweep::new(points, estimate, SWEEP_SECONDS as f32);
        let tracked = tracker.push(&sweep.expect("clusters"));
        let clusters = tracked.expect("a tracked sweep").into_iter();
        let clusters: Vec<u32> = clusters.map(|tracked| tracked.cluster).collect();
        let distinct: BTreeSet<u32> = clusters.iter().copied().collect();
        assert_eq!(distinct.len(), clusters.len(), "a cluster is of one object");
    }
    tracker.finish()
}

fn score(street: &Street, sweeps: &[StreetSweep], tracks: &[Track]) -> TrackingMetrics {
    let mut pool = TrackingPool::default();
    pool.add(&tracked_sweeps(&street.tracks(sweeps), tracks));
    pool.metrics()
}

fn points_of(sweeps: &[StreetSweep]) -> Vec<Vec<Point>> {
    sweeps.iter().map(|sweep| sweep.points.clone()).collect()
}

/// The moving object that shows the most points in the sweep where it shows the fewest.
fn plainest(truth: &[Track]) -> &Track {
    let fewest = |track: &&Track| track.states.iter().map(|state| state.points).min();
    truth.iter().max_by_key(fewest).expect("an object")
}

/// The identity that `tracks` have in a sweep where the true `object` is.
fn identity(object: &Track, tracks: &[Track], sweep: u32) -> Option<u32> {
    let truth = object.states[sweep as usize].bounds.center;
    let near = |track: &&Track| {
        let state = track.states.iter().find(|state| state.sweep == sweep);
        state.is_some_and(|state| {
            let off = |axis: usize| state.bounds.center[axis] - truth[axis];
            off(0).hypot(off(1)) < 2.5
        })
    };
    tracks.iter().find(near).map(|track| track.id)
}

#[test]
fn the_moving_objects_of_a_street_are_followed_with_one_identity_each() {
    let (street, sweeps) = street();
    let tracks = tracks(&points_of(&sweeps));
    let metrics = score(&street, &sweeps, &tracks);
    assert!(metrics.matches * 10 >= metrics.truth * 4, "{metrics:?}");
    assert!(metrics.matches * 10 >= metrics.found * 7, "{metrics:?}");
    assert!(metrics.switches <= 1 && metrics.idf1 > 0.55, "{metrics:?}");
    for track in &tracks {
        let sweeps: Vec<u32> = track.states.iter().map(|state| state.sweep).collect();
        assert!(sweeps.windows(2).all(|pair| pair[1] == pair[0] + 1));
        let sizes = track.states.iter().map(|state| state.bounds.size);
        assert!(
            sizes
                .into_iter()
                .all(|size| size == track.states[0].bounds.size)
        );
        assert!(
            track.states[0].points > 0,
            "a track begins where it is seen"
        );
    }
    let ids: BTreeSet<u32> = tracks.iter().map(|track| track.id).collect();
    assert_eq!(ids.len(), tracks.len());
}

#[test]
fn an_object_that_is_hidden_for_some_sweeps_keeps_its_identity() {
    let (street, sweeps) = street();
    let truth = street.tracks(&sweeps);
    let object = plainest(&truth);
    let mut points = points_of(&sweeps);
    for hidden in 5..8 {
        let mut objects = sweeps[hidden].object.iter();
        let number = object.id as i32 - 1;
        points[hidden].retain(|_| objects.next() != Some(&number));
    }
    let tracks = tracks(&points);
    let before = identity(object, &tracks, 3);
    assert!(before.is_some(), "{object:?}");
    for sweep in [5, 6, 7, 10] {
        assert_eq!(identity(object, &tracks, sweep), before);
    }
    let track = tracks.iter().find(|track| Some(track.id) == before);
    let hidden = track.expect("the object").states.iter();
    let hidden = hidden
        .filter(|state| state.points == 0)
        .map(|state| state.sweep);
    // The last sweep has no estimate.
    assert_eq!(hidden.collect::<Vec<_>>(), [5, 6, 7, SWEEPS as u32 - 1]);
}

#[test]
fn the_vehicle_that_carries_the_sensor_is_no_track() {
    let (_, sweeps) = street();
    let mut points = points_of(&sweeps);
    let bonnet = |i: usize| {
        let [x, y] = [(i % 12) as f32, (i / 12) as f32];
        [1.2 + 0.08 * x, -0.5 + 0.08 * y, -0.6 + 0.01 * x]
    };
    for points in &mut points {
        points.extend((0..144).map(bonnet));
    }
    let near = |track: &Track| {
        let centers = track.states.iter().map(|state| state.bounds.center);
        centers.into_iter().all(|[x, y, _]| x.hypot(y) < 3.0)
    };
    assert!(!tracks(&points).iter().any(near));
}

#[test]
fn estimates_that_cannot_be_tracked_are_refused_and_change_nothing() {
    let (_, sweeps) = street();
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let [source, target] = [0, 1].map(|index: usize| sweeps[index].points.as_slice());
    let problem = Problem::pair(source, target);
    let of = |options: &Options| {
        estimate(&backend, &problem, options, &Uncontrolled).expect("an estimate")
    };
    let plain = Preset::Default.options(None);
    let mut off = plain.clone();
    off.ego = Ego::Off;
    let mut tracker = Tracker::default();
    let mut refused = |points: &[Point], options: &Options| {
        let estimate = of(options);
        let sweep = ClusteredSweep::new(points, &estimate, 0.1);
        sweep
            .and_then(|sweep| tracker.push(&sweep))
            .expect_err("refused")
    };
    assert_eq!(refused(source, &off), TrackError::NoEgoMotion);
    let rows = source.len();
    let points = rows - 1;
    assert_eq!(
        refused(&source[1..], &plain),
        TrackError::Rows { points, rows }
    );
    assert!(tracker.finish().is_empty());
}

#[test]
fn a_van_and_a_rider_of_a_real_drive_keep_their_identities() {
    let Some(data) = real_data() else {
        return;
    };
    let read = |number: usize| {
        let name = format!("{number:010}.pcd");
        let bytes = std::fs::read(data.join("kitti_0000").join(&name)).expect("a sweep");
        read_cloud(&bytes, Some(&name)).expect("a cloud").points
    };
    let sweeps: Vec<Vec<Point>> = (0..11).map(read).collect();
    let tracks = tracks(&sweeps);
    let boxes = std::fs::read(data.join("kitti_drive/tracks.json")).expect("boxes");
    let boxes: serde_json::Value = serde_json::from_slice(&boxes).expect("JSON");
    for (kind, id) in [("Van", 0), ("Cyclist", 1)] {
        let found = |sweep: usize| {
            let all = boxes[sweep.to_string()].as_array().expect("boxes");
            let object = all
                .iter()
                .find(|object| object["id"] == id && object["type"] == kind);
            let center = |axis: usize| object.expect("the box")["center"][axis].as_f64();
            let near = |track: &&Track| {
                let state = track.states.iter().find(|s| s.sweep as usize == sweep);
                state.is_some_and(|state| {
                    let off = |axis: usize| {
                        f64::from(state.bounds.center[axis]) - center(axis).expect("a number")
                    };
                    off(0).hypot(off(1)) < 1.0
                })
            };
            tracks.iter().find(near).map(|track| track.id)
        };
        let first = found(0);
        assert!(first.is_some(), "{kind}: {tracks:?}");
        assert!((1..10).all(|sweep| found(sweep) == first), "{kind}");
    }
}
