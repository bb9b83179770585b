//! Projects of Supervisely: an episode of sweeps with its objects, or clouds with a file of figures each,
//! which is what CVAT reads.
//!
//! ```text
//! meta.json            classes and tags
//! key_id_map.json      numbers of objects, figures and sweeps
//! ds0/pointcloud/SWEEP.pcd
//! ds0/annotation.json, ds0/frame_pointcloud_map.json    of an episode
//! ds0/ann/SWEEP.pcd.json                                of clouds
//! ```

use serde_json::{Map, Value, json};

use super::layout_file::{LayoutFile, vector};
use super::sequence::{BoxSequence, confidence};
use crate::flow::OrientedBox;
use crate::flow::tracks::{Track, TrackState};

/// What a project holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Project {
    /// One sequence: an object is one through all its sweeps.
    Episode,
    /// Clouds with figures of their own; objects of one number are one track.
    Clouds,
}

/// The folder of the clouds of the only data set.
pub(super) fn cloud_path(sweep: &str) -> String {
    format!("ds0/pointcloud/{sweep}.pcd")
}

fn geometry(bounds: &OrientedBox) -> Value {
    json!({
        "position": vector(bounds.center),
        "rotation": vector([0.0, 0.0, bounds.yaw]),
        "dimensions": vector(bounds.size),
    })
}

impl BoxSequence<'_> {
    fn hex(&self, of: &str) -> String {
        self.key(of).simple().to_string()
    }

    fn object_key(&self, track: &Track) -> String {
        self.hex(&format!("object {}", track.id))
    }

    fn figure_key(&self, track: &Track, state: &TrackState) -> String {
        self.hex(&format!("figure {} {}", track.id, state.sweep))
    }

    fn object(&self, track: &Track) -> Value {
        json!({
            "key": self.object_key(track),
            "classTitle": self.class,
            "tags": [{
                "key": self.hex(&format!("confidence {}", track.id)),
                "name": "confidence",
                "value": confidence(track),
            }],
        })
    }

    fn figure(&self, track: &Track, state: &TrackState) -> Value {
        json!({
            "key": self.figure_key(track, state),
            "objectKey": self.object_key(track),
            "geometryType": "cuboid_3d",
            "geometry": geometry(&state.bounds),
        })
    }

    fn meta(&self, project: Project) -> Value {
        json!({
            "classes": [{
                "title": self.class,
                "shape": "cuboid_3d",
                "color": "#E8590C",
                "geometry_config": {},
                "hotkey": "",
            }],
            "tags": [{
                "name": "confidence",
                "value_type": "any_number",
                "color": "#1971C2",
                "hotkey": "",
                "applicable_type": "objectsOnly",
                "classes": [],
            }],
            "projectType": match project {
                Project::Episode => "point_cloud_episodes",
                Project::Clouds => "point_clouds",
            },
        })
    }

    /// The annotation of an episode.
    fn episode(&self) -> Value {
        let objects = self.tracks.iter().map(|track| self.object(track));
        let frames = self.by_sweep().enumerate().map(|(index, (_, boxes))| {
            let figures = boxes.iter().map(|(track, state)| self.figure(track, state));
            json!({"index": index, "figures": Value::from_iter(figures)})
        });
        json!({
            "description": "",
            "key": self.hex("episode"),
            "tags": [],
            "objects": Value::from_iter(objects),
            "framesCount": self.sweeps.len(),
            "frames": Value::from_iter(frames),
        })
    }

    /// The annotation of each cloud.
    fn clouds(&self) -> impl Iterator<Item = LayoutFile> {
        self.by_sweep().map(move |(name, boxes)| {
            let objects = boxes.iter().map(|(track, _)| self.object(track));
            let figures = boxes.iter().map(|(track, state)| self.figure(track, state));
            let annotation = json!({
                "description": "",
                "key": self.hex(&format!("cloud {name}")),
                "tags": [],
                "objects": Value::from_iter(objects),
                "figures": Value::from_iter(figures),
            });
            LayoutFile::json(format!("ds0/ann/{name}.pcd.json"), &annotation)
        })
    }

    /// The numbers of all keys: of objects those of the tracks, of sweeps their indices.
    fn numbers(&self) -> Value {
        let objects = self.tracks.iter();
        let objects = objects.map(|track| (self.object_key(track), Value::from(track.id)));
        let boxes = self.by_sweep().flat_map(|(_, boxes)| boxes);
        let figures = boxes
            .zip(1_u64..)
            .map(|((track, state), number)| (self.figure_key(track, state), Value::from(number)));
        let names = self.sweeps.iter().zip(0_u64..);
        let sweeps =
            names.map(|(name, index)| (self.hex(&format!("cloud {name}")), Value::from(index)));
        json!({
            "tags": {},
            "objects": Map::from_iter(objects),
            "figures": Map::from_iter(figures),
            "videos": Map::from_iter(sweeps),
        })
    }
}

/// The files of a project, without its clouds.
pub(super) fn files(sequence: &BoxSequence<'_>, project: Project) -> Vec<LayoutFile> {
    let mut files = vec![LayoutFile::json("meta.json", &sequence.meta(project))];
    match project {
        Project::Episode => {
            // The server gives the numbers.
            let none = json!({"tags": {}, "objects": {}, "figures": {}, "videos": {}});
            let names = sequence.sweeps.iter().enumerate();
            let names =
                names.map(|(index, name)| (index.to_string(), format!("{name}.pcd").into()));
            files.extend([
                LayoutFile::json("key_id_map.json", &none),
                LayoutFile::json("ds0/annotation.json", &sequence.episode()),
                LayoutFile::json(
                    "ds0/frame_pointcloud_map.json",
                    &Value::Object(Map::from_iter(names)),
                ),
            ]);
        }
        Project::Clouds => {
            files.push(LayoutFile::json("key_id_map.json", &sequence.numbers()));
            files.extend(sequence.clouds());
        }
    }
    files
}

#[cfg(test)]
mod tests {
    use super::super::samples::{names, tracks};
    use super::*;

    fn read(files: &[LayoutFile], path: &str) -> Value {
        let file = files.iter().find(|file| file.path == path);
        let file = file.unwrap_or_else(|| panic!("no {path}"));
        serde_json::from_slice(&file.bytes).expect("JSON")
    }

    #[test]
    fn an_object_of_an_episode_has_a_figure_in_each_of_its_sweeps() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "mover").expect("a sequence");
        let files = files(&sequence, Project::Episode);
        let episode = read(&files, "ds0/annotation.json");
        assert_eq!(episode["framesCount"], 3);
        let key = &episode["objects"][0]["key"];
        assert_eq!(episode["objects"][0]["tags"][0]["value"], 0.75);
        for index in 0..3 {
            let figure = &episode["frames"][index]["figures"][0];
            assert_eq!(figure["objectKey"], *key);
            assert_eq!(figure["geometry"]["position"]["x"], 1.0 + index as f64);
            assert_eq!(figure["geometry"]["dimensions"]["x"], 4.5);
        }
        let map = read(&files, "ds0/frame_pointcloud_map.json");
        assert_eq!(map["2"], "c.pcd");
    }

    #[test]
    fn a_track_has_one_number_in_all_clouds() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "mover").expect("a sequence");
        let files = files(&sequence, Project::Clouds);
        let numbers = read(&files, "key_id_map.json");
        for (index, name) in names.iter().enumerate() {
            let cloud = read(&files, &format!("ds0/ann/{name}.pcd.json"));
            let key = |value: &Value| value["key"].as_str().expect("a key").to_owned();
            assert_eq!(numbers["videos"][key(&cloud)], index);
            assert_eq!(numbers["objects"][key(&cloud["objects"][0])], 1);
        }
        assert_eq!(numbers["figures"].as_object().expect("numbers").len(), 4);
    }
}
