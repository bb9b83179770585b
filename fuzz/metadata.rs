//! What comes beside the clouds: JSON, calibrations, poses, depth images, rasters and names.

use fnsf::flow::RigidTransform;
use fnsf::formats::{
    GroundRaster, INTERVAL_S, PoseFile, SweepTime, compare_names, is_dense, is_tracks,
    pair_interval_s, read_camera, read_camera0_from_lidar, read_depth_png, read_flow, read_motion,
    read_poses, read_tracks, turning_sweep, write_depth_png, write_tracks,
};
use libfuzzer_sys::Corpus;

use crate::pieces::Pieces;

/// Flows, tracks and poses as JSON.
pub(crate) fn json(bytes: &[u8]) -> Corpus {
    if let Ok(flow) = read_flow(bytes, None) {
        assert!(
            flow.flow
                .as_flattened()
                .iter()
                .all(|value| value.is_finite())
        );
    }
    let _poses = read_poses(bytes, &["0", "1"]);
    let _is_either = (is_dense(bytes), is_tracks(bytes));
    if let Ok(tracks) = read_tracks(bytes) {
        let mut written = Vec::new();
        write_tracks(&tracks, &mut written).expect("what was read is written");
        let again = read_tracks(&written).expect("what was written is read");
        assert!(again == tracks, "other tracks are read back");
    }
    Corpus::Keep
}

/// Texts of numbers. The first line's length parts the input into two files.
pub(crate) fn calibration(bytes: &[u8]) -> Corpus {
    let mut pieces = Pieces(bytes);
    let beside = pieces.counted();
    let text = pieces.0;
    let _refused = (read_camera(text, None), read_camera(text, Some(beside)));
    let _refused = read_camera0_from_lidar(text, Some(beside));
    if let Ok(motion) = read_motion(text) {
        assert!(is_rigid(&motion));
    }
    let sweeps = ["000000.bin", "000001.bin"];
    if let Ok(poses) = read_poses(text, &sweeps) {
        assert!(poses.len() == sweeps.len() && poses.iter().all(is_rigid));
    }
    if let Ok(file) = PoseFile::open(text) {
        let _refused = (file.pose(0, sweeps[0]), file.check_count(2));
    }
    Corpus::Keep
}

fn is_rigid(motion: &RigidTransform) -> bool {
    let length = motion.rotation.norm();
    (length - 1.0).abs() < 1e-9
        && motion
            .translation
            .vector
            .iter()
            .all(|value| value.is_finite())
}

/// Depth images.
pub(crate) fn png(bytes: &[u8]) -> Corpus {
    let Ok(image) = read_depth_png(bytes) else {
        return Corpus::Keep;
    };
    assert_eq!(
        image.metres.len(),
        image.width as usize * image.height as usize
    );
    let mut written = Vec::new();
    write_depth_png(&image, &mut written).expect("what was read is written");
    let again = read_depth_png(&written).expect("what was written is read");
    assert!(again.metres == image.metres, "another image is read back");
    Corpus::Keep
}

/// A raster of heights and its place.
pub(crate) fn raster(bytes: &[u8]) -> Corpus {
    let mut pieces = Pieces(bytes);
    let place = pieces.counted();
    if let Ok(raster) = GroundRaster::read(pieces.0, place) {
        let points = [[0.0; 3], [1e6; 3], [-1.0, 2.0, f32::NAN], [f32::MAX; 3]];
        let ground = raster.ground(&points, &RigidTransform::identity());
        assert_eq!(ground.len(), points.len());
    }
    Corpus::Keep
}

/// File names, one on each line.
pub(crate) fn names(bytes: &[u8]) -> Corpus {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return Corpus::Reject;
    };
    let names: Vec<&str> = text.lines().take(12).collect();
    let _turns = turning_sweep(&names);
    for one in &names {
        let _time = SweepTime::from_name(one);
        for other in &names {
            let order = compare_names(one, other);
            assert_eq!(order, compare_names(other, one).reverse());
            for third in &names {
                if order.is_le() && compare_names(other, third).is_le() {
                    assert!(
                        compare_names(one, third).is_le(),
                        "{one:?} {other:?} {third:?}"
                    );
                }
            }
            let interval = pair_interval_s([one, other], [None, None]);
            if let Some(seconds) = interval {
                assert!((INTERVAL_S[0]..=INTERVAL_S[1]).contains(&seconds.abs()));
            }
            let reversed = pair_interval_s([other, one], [None, None]);
            assert_eq!(interval, reversed.map(|seconds| -seconds));
        }
    }
    Corpus::Keep
}
