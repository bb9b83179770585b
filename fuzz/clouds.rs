//! Files of clouds, pairs and flows: whatever is accepted is within the limits, agrees between the
//! readers, and is read again as it was written.

use std::io::ErrorKind;
use std::ops::ControlFlow;
use std::sync::Arc;

use fnsf::formats::{
    CloudFormat, FileKind, MAX_COORDINATE_M, Scene, SceneSweep, declared_rows, is_pair,
    read_av2_labels, read_av2_mask, read_cloud, read_cloud_within, read_flow, read_intensity,
    read_pair, read_pair_within, read_poses, read_recording, read_timed_cloud, recognize,
    write_cloud, write_pair_npz,
};
use libfuzzer_sys::Corpus;

pub(crate) fn npy(bytes: &[u8]) -> Corpus {
    file(bytes, FileKind::Npy)
}

pub(crate) fn npz(bytes: &[u8]) -> Corpus {
    file(bytes, FileKind::Npz)
}

pub(crate) fn ply(bytes: &[u8]) -> Corpus {
    file(bytes, FileKind::Ply)
}

pub(crate) fn pcd(bytes: &[u8]) -> Corpus {
    file(bytes, FileKind::Pcd)
}

pub(crate) fn feather(bytes: &[u8]) -> Corpus {
    file(bytes, FileKind::Feather)
}

pub(crate) fn las(bytes: &[u8]) -> Corpus {
    file(bytes, FileKind::Las)
}

/// Raw floats: the name tells the kind, and the content where the name does not.
pub(crate) fn bin(bytes: &[u8]) -> Corpus {
    for name in ["a.bin", "a.kitti.bin", "a.pcd.bin"] {
        cloud(bytes, Some(name));
    }
    Corpus::Keep
}

/// Recordings: every cloud is decoded, and has finite points and a time for each or none.
pub(crate) fn mcap(bytes: &[u8]) -> Corpus {
    if recognize(bytes, None).ok() != Some(FileKind::Mcap) {
        return Corpus::Reject;
    }
    let _read = read_recording(bytes, |message| {
        if let Ok(sweep) = message.sweep() {
            let is_finite = |value: &f32| value.is_finite();
            assert!(sweep.points.iter().flatten().all(is_finite));
            if let Some(times) = sweep.times {
                assert_eq!(times.offsets_s.len(), sweep.points.len());
                assert!(times.offsets_s.iter().all(is_finite));
            }
        }
        ControlFlow::Continue(())
    });
    Corpus::Keep
}

/// Scenes: every sweep and its truth, of finite numbers and with a row for each point.
pub(crate) fn scene(bytes: &[u8]) -> Corpus {
    if recognize(bytes, None).ok() != Some(FileKind::Hdf5) {
        return Corpus::Reject;
    }
    let length = bytes.len() as u64;
    let bytes: Arc<[u8]> = bytes.into();
    let read_at = move |offset: u64, into: &mut [u8]| {
        let rest = usize::try_from(offset)
            .ok()
            .and_then(|from| bytes.get(from..));
        let found = rest.and_then(|rest| rest.get(..into.len()));
        into.copy_from_slice(found.ok_or(ErrorKind::UnexpectedEof)?);
        Ok(())
    };
    let Ok(scene) = Scene::open(length, read_at) else {
        return Corpus::Keep;
    };
    let mut before: Option<SceneSweep> = None;
    for index in 0..scene.names().len().min(4) {
        let Ok(sweep) = scene.sweep(index) else {
            before = None;
            continue;
        };
        assert!(sweep.points.iter().flatten().all(|value| value.is_finite()));
        if let Some(source) = &before
            && let Ok(Some(pair)) = scene.pair(index - 1, [source, &sweep])
        {
            let truth = pair.truth.expect("a flow");
            assert_eq!(truth.flow.len(), pair.source.len());
            assert!(truth.flow.iter().flatten().all(|value| value.is_finite()));
        }
        before = Some(sweep);
    }
    Corpus::Keep
}

/// A file of one kind, by every reader that takes it.
fn file(bytes: &[u8], kind: FileKind) -> Corpus {
    if recognize(bytes, None).ok() != Some(kind) {
        return Corpus::Reject;
    }
    cloud(bytes, None);
    flow(bytes);
    match kind {
        FileKind::Npz => pair(bytes),
        FileKind::Feather => labels(bytes),
        _ => {}
    }
    Corpus::Keep
}

fn cloud(bytes: &[u8], name: Option<&str>) {
    let timed = read_timed_cloud(bytes, name);
    let Ok(cloud) = read_cloud(bytes, name) else {
        assert!(timed.is_err(), "times make no file a cloud");
        return;
    };
    if let Ok(timed) = timed {
        // NaN marks a beam without return.
        assert_eq!(timed.cloud.points.len(), cloud.points.len());
    }
    if let Ok(Some(intensities)) = read_intensity(bytes, name)
        && recognize(bytes, name).is_ok_and(|kind| kind != FileKind::Npz)
    {
        assert_eq!(intensities.len(), cloud.points.len());
    }
    let rows = declared_rows(bytes, name).expect("a readable file declares its rows");
    assert!(rows >= cloud.points.len(), "{rows} rows are declared");
    if let Some(fewer) = cloud.points.len().checked_sub(1) {
        assert!(
            read_cloud_within(bytes, name, fewer).is_err(),
            "more rows than allowed"
        );
    }
    let is_out = |point: &&[f32; 3]| {
        !point
            .iter()
            .all(|value| value.abs() <= MAX_COORDINATE_M as f32)
    };
    let out = cloud.points.iter().filter(is_out);
    let nan = out.filter(|point| point.iter().all(|value| value.is_nan()));
    assert_eq!(nan.count(), cloud.no_return);
    assert_eq!(cloud.points.iter().filter(is_out).count(), cloud.no_return);

    let mut written = Vec::new();
    write_cloud(CloudFormat::Pcd, &cloud.points, &mut written).expect("what was read is written");
    let again = read_cloud(&written, None).expect("what was written is read");
    let bits = |points: &[[f32; 3]]| -> Vec<u32> {
        points
            .as_flattened()
            .iter()
            .map(|value| value.to_bits())
            .collect()
    };
    // The payload of a NaN may change.
    if cloud.no_return == 0 {
        assert!(
            bits(&cloud.points) == bits(&again.points),
            "another cloud is read back"
        );
    }
}

fn flow(bytes: &[u8]) {
    let Ok(file) = read_flow(bytes, None) else {
        return;
    };
    let rows = file.flow.len();
    let counts = [
        file.valid.map(|valid| valid.len()),
        file.dynamic.map(|dynamic| dynamic.len()),
        file.cluster.as_ref().map(Vec::len),
        file.confidence.map(|probabilities| probabilities.len()),
        file.moving.map(|probabilities| probabilities.len()),
    ];
    assert!(
        counts.into_iter().flatten().all(|count| count == rows),
        "a column of another length"
    );
    assert!(
        file.flow
            .as_flattened()
            .iter()
            .all(|value| value.is_finite())
    );
}

fn pair(bytes: &[u8]) {
    let Ok(pair) = read_pair(bytes) else {
        return;
    };
    assert!(is_pair(bytes));
    if let Some(fewer) = pair.source.len().max(pair.target.len()).checked_sub(1) {
        assert!(
            read_pair_within(bytes, fewer).is_err(),
            "more rows than allowed"
        );
    }
    let mut written = Vec::new();
    write_pair_npz(&pair, &mut written).expect("what was read is written");
    let again = read_pair(&written).expect("what was written is read");
    assert!(again.source == pair.source && again.target == pair.target);
    assert!(again.truth == pair.truth && again.ground == pair.ground);
}

fn labels(bytes: &[u8]) {
    let _refused = read_av2_mask(bytes);
    let _refused = read_poses(bytes, &["315966265259836000"]);
    if let Ok(labels) = read_av2_labels(bytes) {
        assert_eq!(labels.truth.flow.len(), labels.ground.len());
    }
}
