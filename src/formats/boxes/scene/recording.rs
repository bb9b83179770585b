//! The recording of a sequence, sweep by sweep.

use std::io::{self, Write};

use super::super::sequence::BoxSequence;
use super::messages::{point_cloud, transform, update};
use super::schema::descriptor_set;
use crate::flow::{Point, RigidTransform};
use crate::formats::mcap::{RecordingWriter, Topic};
use crate::formats::timestamps::SweepTime;

/// Time between two sweeps whose names have no times, nanoseconds.
const INTERVAL_NS: u64 = 100_000_000;

/// Writes the clouds of a sequence with the boxes of its tracks as a recording.
///
/// | topic | message | |
/// |---|---|---|
/// | `/lidar` | `foxglove.PointCloud` | x, y, z of the points, metres, in the frame `lidar` |
/// | `/objects` | `foxglove.SceneUpdate` | an entity for each track: a box, its velocity, its number |
/// | `/tf` | `foxglove.FrameTransform` | the pose of `lidar` in `world`, if poses are given |
pub struct SceneRecording<'a, W> {
    sequence: &'a BoxSequence<'a>,
    poses: Option<&'a [RigidTransform]>,
    times_ns: Vec<u64>,
    writer: RecordingWriter<W>,
    channels: [u16; 3],
    /// Sweeps written.
    sweeps: usize,
}

/// The times of the sweeps: those in their names if each has one, and they rise.
fn times_ns(names: &[String]) -> Vec<u64> {
    let named = names.iter();
    let named = named.map(|name| SweepTime::from_name(name)?.nanoseconds());
    let named: Option<Vec<u64>> = named.collect();
    let named = named.filter(|times| times.is_sorted_by(|a, b| a < b));
    let counted = || (0..).step_by(INTERVAL_NS as usize).take(names.len());
    named.unwrap_or_else(|| counted().collect())
}

impl<'a, W: Write> SceneRecording<'a, W> {
    /// Begins the recording of a `sequence`. `poses`, if given, are `world_from_sensor` of each sweep.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn start(
        sequence: &'a BoxSequence<'a>,
        poses: Option<&'a [RigidTransform]>,
        out: W,
    ) -> io::Result<Self> {
        let schema = descriptor_set();
        let mut writer = RecordingWriter::start(out)?;
        let mut channel = |name: &str, schema_name: &str| {
            writer.channel(&Topic {
                name,
                encoding: "protobuf",
                schema_name,
                schema_encoding: "protobuf",
                schema: &schema,
            })
        };
        let clouds = channel("/lidar", "foxglove.PointCloud")?;
        let boxes = channel("/objects", "foxglove.SceneUpdate")?;
        let motion = match poses {
            Some(_) => channel("/tf", "foxglove.FrameTransform")?,
            None => 0,
        };
        Ok(Self {
            sequence,
            poses,
            times_ns: times_ns(sequence.sweeps),
            writer,
            channels: [clouds, boxes, motion],
            sweeps: 0,
        })
    }

    /// Writes the next sweep, which has these points. The sequence must have one more.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn sweep(&mut self, points: &[Point]) -> io::Result<()> {
        let index = self.sweeps;
        self.sweeps += 1;
        let ns = self.times_ns[index];
        let sequence = self.sequence;
        let boxes = sequence.boxes(index);
        let before: &[_] = match index {
            0 => &[],
            _ => sequence.boxes(index - 1),
        };
        let goes_on = |id: u32| boxes.iter().any(|(track, _)| track.id == id);
        let ended = before.iter().map(|(track, _)| track.id);
        let ended: Vec<u32> = ended.filter(|&id| !goes_on(id)).collect();
        let [clouds, objects, motion] = self.channels;
        let mut messages = Vec::new();
        if let Some(poses) = self.poses {
            messages.push((motion, transform(ns, &poses[index]).into_bytes()));
        }
        messages.push((clouds, point_cloud(ns, points).into_bytes()));
        let update = update(ns, sequence.class, boxes, &ended);
        messages.push((objects, update.into_bytes()));
        self.writer.chunk(ns, &messages)
    }

    /// Ends the recording with its index.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn finish(self) -> io::Result<()> {
        self.writer.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::samples::{names, tracks};
    use super::*;

    #[test]
    fn times_are_those_of_the_names_or_a_tenth_of_a_second_apart() {
        let names_of = |names: [&str; 2]| names.map(str::to_owned);
        let stamped = names_of(["315966265259836000", "315966265359836000"]);
        assert_eq!(
            times_ns(&stamped),
            [315_966_265_259_836_000, 315_966_265_359_836_000]
        );
        let backwards = names_of(["315966265359836000", "315966265259836000"]);
        assert_eq!(times_ns(&backwards), [0, INTERVAL_NS]);
        assert_eq!(times_ns(&names()), [0, INTERVAL_NS, 2 * INTERVAL_NS]);
    }

    #[test]
    fn a_recording_is_the_same_in_every_run_and_has_the_points_of_its_sweeps() {
        let (tracks, names) = (tracks(), names());
        let sequence = BoxSequence::new(&tracks, &names, "mover").expect("a sequence");
        let poses = [RigidTransform::identity(); 3];
        let point = [1.25_f32, -2.5, 0.75];
        let write = || {
            let mut bytes = Vec::new();
            let mut scene =
                SceneRecording::start(&sequence, Some(&poses), &mut bytes).expect("memory");
            for _ in &names {
                scene.sweep(&[point, [f32::NAN; 3]]).expect("memory");
            }
            scene.finish().expect("memory");
            bytes
        };
        let bytes = write();
        assert_eq!(bytes, write());
        let data: Vec<u8> = point.iter().flat_map(|value| value.to_le_bytes()).collect();
        let found = bytes.windows(data.len()).filter(|at| *at == data).count();
        assert_eq!(found, 3);
    }
}
