//! nuScenes' tracking task: `tracking.json`, the boxes of each sample in the frame of the map.
//!
//! A sample is a key frame; there are two a second. Boxes of other sweeps are left out.

use std::collections::HashMap;
use std::path::Path;

use nalgebra::{Point3, UnitQuaternion, Vector3};
use serde_json::{Map, Value, json};

use super::layout_file::LayoutFile;
use super::sequence::{BoxSequence, confidence};
use crate::flow::RigidTransform;
use crate::flow::tracks::{Track, TrackState};
use crate::formats::error::{FileKind, FormatError};
use crate::formats::nuscenes::{NuscenesScene, NuscenesSweep};

/// The classes of the task.
const CLASSES: [&str; 7] = [
    "bicycle",
    "bus",
    "car",
    "motorcycle",
    "pedestrian",
    "trailer",
    "truck",
];

/// Name of a sweep of the data set: its file name without folder and ending.
fn name_of(sweep: &NuscenesSweep) -> Option<&str> {
    Path::new(&sweep.file).file_stem()?.to_str()
}

/// A box in the frame of the map. `size` is width, length, height.
fn result(
    sample: &str,
    class: &str,
    world_from_sensor: &RigidTransform,
    (track, state): &(&Track, &TrackState),
) -> Value {
    let bounds = &state.bounds;
    let center = world_from_sensor * Point3::from(bounds.center.map(f64::from));
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), f64::from(bounds.yaw));
    let rotation = world_from_sensor.rotation * yaw;
    let velocity = world_from_sensor.rotation * Vector3::from(state.velocity.map(f64::from));
    let [length, width, height] = bounds.size;
    json!({
        "sample_token": sample,
        "translation": [center.x, center.y, center.z],
        "size": [width, length, height],
        "rotation": [rotation.w, rotation.i, rotation.j, rotation.k],
        "velocity": [velocity.x, velocity.y],
        "tracking_id": track.id.to_string(),
        "tracking_name": class,
        "tracking_score": confidence(track),
    })
}

/// The results of a sequence, whose sweeps are named as in the data set.
///
/// # Errors
/// `Unsupported` for a class that the task does not have, for a sweep that no scene has, and where no
/// sweep is a key frame.
pub(super) fn file(
    sequence: &BoxSequence<'_>,
    scenes: &[NuscenesScene],
) -> Result<LayoutFile, FormatError> {
    let refuse = |why: String| Err(FileKind::Json.unsupported(why));
    let class = sequence.class;
    if !CLASSES.contains(&class) {
        let known = CLASSES.join(", ");
        return refuse(format!(
            "nuScenes tracks the classes {known}, and not \"{class}\""
        ));
    }
    let sweeps = scenes.iter().flat_map(|scene| &scene.sweeps);
    let by_name: HashMap<_, _> = sweeps
        .filter_map(|sweep| Some((name_of(sweep)?, sweep)))
        .collect();
    let mut results = Map::new();
    for (name, boxes) in sequence.by_sweep() {
        let Some(sweep) = by_name.get(name) else {
            return refuse(format!("no scene of the tables has a sweep {name}"));
        };
        let Some(sample) = &sweep.sample else {
            continue;
        };
        let boxes = boxes.iter();
        let boxes = boxes.map(|one| result(sample, class, &sweep.world_from_sensor, one));
        results.insert(sample.clone(), boxes.collect());
    }
    if results.is_empty() {
        return refuse(
            "results are of key frames, and no sweep is one: give all sweeps".to_owned(),
        );
    }
    let meta = json!({
        "use_camera": false,
        "use_lidar": true,
        "use_radar": false,
        "use_map": false,
        "use_external": false,
    });
    let content = json!({"meta": meta, "results": results});
    Ok(LayoutFile::json("tracking.json", &content))
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;

    use super::super::samples::{names, tracks};
    use super::*;

    /// Sweeps `a` and `c` are key frames. The map's x axis is the lidar's y axis.
    fn scenes() -> Vec<NuscenesScene> {
        let turned = UnitQuaternion::from_euler_angles(0.0, 0.0, -std::f64::consts::FRAC_PI_2);
        let sweep = |name: &str, sample: Option<&str>| NuscenesSweep {
            file: format!("sweeps/LIDAR_TOP/{name}.bin"),
            timestamp_us: 0,
            world_from_sensor: RigidTransform::from_parts(
                Translation3::new(100.0, 200.0, 2.0),
                turned,
            ),
            sample: sample.map(str::to_owned),
        };
        vec![NuscenesScene {
            name: "scene-0061".to_owned(),
            sweeps: vec![
                sweep("a", Some("s0")),
                sweep("b", None),
                sweep("c", Some("s1")),
            ],
        }]
    }

    #[test]
    fn boxes_of_key_frames_are_in_the_frame_of_the_map() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "car").expect("a sequence");
        let file = file(&sequence, &scenes()).expect("a file");
        assert_eq!(file.path, "tracking.json");
        let content: Value = serde_json::from_slice(&file.bytes).expect("JSON");
        let results = content["results"].as_object().expect("results");
        let counts: Vec<_> = results
            .iter()
            .map(|(sample, boxes)| (sample.as_str(), boxes.as_array().map(Vec::len)))
            .collect();
        assert_eq!(counts, [("s0", Some(1)), ("s1", Some(2))]);
        let first = &results["s0"][0];
        let near = |found: &Value, wanted: &[f64]| {
            let found = found.as_array().expect("numbers");
            assert_eq!(found.len(), wanted.len());
            for (found, wanted) in found.iter().zip(wanted) {
                let found = found.as_f64().expect("a number");
                assert!((found - wanted).abs() < 1e-6, "{found} {wanted}");
            }
        };
        near(&first["translation"], &[98.0, 199.0, 2.5]);
        near(&first["size"], &[1.75, 4.5, 1.5]);
        near(&first["velocity"], &[0.5, -8.0]);
        let half = (0.25 - std::f64::consts::FRAC_PI_2) / 2.0;
        near(&first["rotation"], &[half.cos(), 0.0, 0.0, half.sin()]);
        assert_eq!(first["tracking_id"], results["s1"][0]["tracking_id"]);
        assert_eq!(first["tracking_score"], 0.75);
    }

    #[test]
    fn classes_and_sweeps_that_the_data_set_does_not_have_are_refused() {
        let (tracks, names) = (tracks(), names());
        let refused = |class: &str, scenes: &[NuscenesScene]| {
            let sequence = BoxSequence::new(&tracks, &names, class).expect("a sequence");
            file(&sequence, scenes).expect_err("a refusal").to_string()
        };
        let said = refused("mover", &scenes());
        assert!(
            said.contains("car, motorcycle") && said.contains("\"mover\""),
            "{said}"
        );
        let mut scenes = scenes();
        for sweep in &mut scenes[0].sweeps {
            sweep.sample = None;
        }
        let said = refused("car", &scenes);
        assert!(said.contains("no sweep is one"), "{said}");
        scenes[0].sweeps.pop();
        let said = refused("car", &scenes);
        assert!(said.contains("has a sweep c"), "{said}");
    }
}
