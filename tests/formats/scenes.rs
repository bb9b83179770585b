//! Tests of scenes of OpenSceneFlow.
//!
//! The Python package `h5py` wrote the files: `plain.h5` as it does by itself, `gzip.h5` and `lzf.h5` in its newest
//! form, in compressed pieces. Each has two sweeps of 106 points, 0.1 s apart, with the flow of the first.

use std::f64::consts::PI;
use std::sync::Arc;

use fnsf::flow::DYNAMIC_M;
use fnsf::formats::{FormatError, Pair, Scene, SceneSweep, read_cloud};

const PLAIN: &[u8] = include_bytes!("scenes/plain.h5");
const GZIP: &[u8] = include_bytes!("scenes/gzip.h5");
const LZF: &[u8] = include_bytes!("scenes/lzf.h5");
const ALL: [&[u8]; 3] = [PLAIN, GZIP, LZF];
const POINTS: usize = 106;

fn open(bytes: &[u8]) -> Result<Scene, FormatError> {
    let bytes: Arc<[u8]> = bytes.into();
    Scene::open(bytes.len() as u64, move |offset, into| {
        let from = usize::try_from(offset).expect("a short file");
        let found = bytes.get(from..).and_then(|rest| rest.get(..into.len()));
        let found = found.ok_or(std::io::ErrorKind::UnexpectedEof)?;
        into.copy_from_slice(found);
        Ok(())
    })
}

/// All of a scene, or the first error.
fn all(bytes: &[u8]) -> Result<(Vec<SceneSweep>, Option<Pair>), FormatError> {
    let scene = open(bytes)?;
    let sweeps = (0..scene.names().len()).map(|index| scene.sweep(index));
    let sweeps: Vec<SceneSweep> = sweeps.collect::<Result<_, _>>()?;
    let pair = match &sweeps[..] {
        [source, target, ..] => scene.pair(0, [source, target])?,
        _ => None,
    };
    Ok((sweeps, pair))
}

/// Point `i` of sweep `sweep`.
fn point(sweep: usize, i: usize) -> [f32; 3] {
    let x = 0.25 * i as f32 - 10.0 + sweep as f32;
    [x, (i % 7) as f32 - 3.0, 0.5 * (i % 3) as f32]
}

#[test]
fn points_masks_and_times_are_read_whether_plain_or_compressed() {
    for bytes in ALL {
        let scene = open(bytes).expect("a scene");
        let names: Vec<&str> = scene.names().collect();
        assert_eq!(names, ["1700000000000000000", "1700000000100000000"]);
        for index in 0..2 {
            let sweep = scene.sweep(index).expect("a sweep");
            assert_eq!(sweep.points.len(), POINTS);
            let ground = sweep.ground.expect("a mask");
            let times = sweep.times.expect("times");
            for (i, found) in sweep.points.iter().enumerate() {
                assert_eq!(*found, point(index, i));
                assert_eq!(ground[i], i % 3 == 0);
                assert!((times.offsets_s[i] - 0.0005 * i as f32).abs() < 1e-6);
            }
        }
    }
}

#[test]
fn the_truth_has_the_ego_motion_of_the_points_and_not_that_of_the_vehicle() {
    for bytes in ALL {
        let (sweeps, pair) = all(bytes).expect("a scene");
        let pair = pair.expect("a flow");
        assert_eq!(pair.target, sweeps[1].points);
        let truth = pair.truth.expect("truth");
        assert!(
            !truth.valid[7] && truth.valid.iter().filter(|&&valid| valid).count() == POINTS - 1
        );
        let foreground = truth.foreground.expect("categories");
        assert!(foreground.iter().enumerate().all(|(i, &on)| on == (i < 5)));
        assert_eq!(
            truth.category.expect("categories")[..6],
            [19, 19, 19, 19, 19, 0]
        );
        // The sensor turns by two degrees. The file's own ego motion is none.
        let ego = pair.ego.expect("an ego motion");
        assert!((ego.rotation.scaled_axis().z - 2.0 * PI / 180.0).abs() < 1e-6);
        assert!((ego.translation.x + 1.0).abs() < 1e-5, "{ego}");
        for (i, flow) in truth.flow.iter().enumerate().filter(|&(i, _)| i != 7) {
            let at = nalgebra::Point3::from(point(0, i).map(f64::from));
            let moved = ego * at - at;
            let apart = (0..3).map(|axis| (f64::from(flow[axis]) - moved[axis]).powi(2));
            let moves = apart.sum::<f64>().sqrt() > f64::from(DYNAMIC_M);
            assert_eq!(moves, i < 5, "{i}");
        }
    }
}

#[test]
fn a_scene_that_was_cut_off_is_refused() {
    for bytes in ALL {
        for length in 0..bytes.len() {
            assert!(all(&bytes[..length]).is_err(), "{length}");
        }
    }
}

#[test]
fn a_changed_byte_is_read_or_refused_and_never_gives_a_number_that_is_not_finite() {
    let is_finite = |points: &[[f32; 3]]| points.iter().flatten().all(|value| value.is_finite());
    for bytes in ALL {
        for place in 0..bytes.len() {
            for flip in [0x01, 0x80, 0xff] {
                let mut damaged = bytes.to_vec();
                damaged[place] ^= flip;
                let Ok((sweeps, pair)) = all(&damaged) else {
                    continue;
                };
                assert!(sweeps.iter().all(|sweep| is_finite(&sweep.points)));
                if let Some(truth) = pair.and_then(|pair| pair.truth) {
                    assert!(is_finite(&truth.flow));
                }
            }
        }
    }
}

/// Ten groups link to one array, which is declared and was never written.
#[test]
fn arrays_that_together_have_far_more_bytes_than_the_file_are_refused() {
    let refused = open(include_bytes!("scenes/linked.h5")).err();
    let refused = refused.expect("a bomb").to_string();
    assert!(refused.contains("declare 240000000 bytes"), "{refused}");
}

#[test]
fn an_hdf5_file_of_something_else_is_refused_with_what_is_needed() {
    // The groups are not named by a time.
    let mut renamed = PLAIN.to_vec();
    let name = b"1700000000";
    while let Some(at) = renamed.windows(name.len()).position(|part| part == name) {
        renamed[at] = b'a';
    }
    let refused = open(&renamed).err().expect("no sweep").to_string();
    assert!(refused.contains("named by its time"), "{refused}");
    let refused = read_cloud(PLAIN, Some("scene.h5")).expect_err("a scene");
    assert!(refused.to_string().contains("fnsf unpack"), "{refused}");
}
