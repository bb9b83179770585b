//! SUSTechPOINTS: the boxes of each sweep as a list in `label/SWEEP.json`.

use serde_json::{Value, json};

use super::layout_file::{LayoutFile, vector};
use super::sequence::BoxSequence;

/// A file for each sweep, with an empty list where nothing moves.
pub(super) fn files(sequence: &BoxSequence<'_>) -> Vec<LayoutFile> {
    let files = sequence.by_sweep().map(|(name, boxes)| {
        let boxes = boxes.iter().map(|(track, state)| {
            let bounds = &state.bounds;
            json!({
                "obj_id": track.id.to_string(),
                "obj_type": sequence.class,
                "psr": {
                    "position": vector(bounds.center),
                    "rotation": vector([0.0, 0.0, bounds.yaw]),
                    "scale": vector(bounds.size),
                },
            })
        });
        LayoutFile::json(format!("label/{name}.json"), &Value::from_iter(boxes))
    });
    files.collect()
}

#[cfg(test)]
mod tests {
    use super::super::samples::{names, tracks};
    use super::*;

    #[test]
    fn every_sweep_has_its_boxes_with_center_size_and_yaw() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "Car").expect("a sequence");
        let files = files(&sequence);
        assert_eq!(files[2].path, "label/c.json");
        let read: Value = serde_json::from_slice(&files[2].bytes).expect("JSON");
        assert_eq!(
            (&read[0]["obj_id"], &read[1]["obj_id"]),
            (&"1".into(), &"4".into())
        );
        assert_eq!(read[0]["obj_type"], "Car");
        let psr = &read[0]["psr"];
        assert_eq!(psr["position"], json!({"x": 3.0, "y": -2.0, "z": 0.5}));
        assert_eq!(psr["scale"], json!({"x": 4.5, "y": 1.75, "z": 1.5}));
        assert_eq!(psr["rotation"]["z"], 0.25);
    }
}
