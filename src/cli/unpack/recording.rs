//! The sweeps of a recording as files.

use std::collections::{BTreeMap, HashSet};
use std::fs::File;
use std::io::BufReader;
use std::ops::ControlFlow;
use std::path::PathBuf;

use anyhow::{Context, anyhow};

use super::arguments::Unpack;
use super::sweep_file::{folder_of, write_sweep};
use crate::cli::failure::Failure;
use crate::cli::output::{complain, say};
use crate::cli::terminal::bar;
use crate::formats::{CloudMessage, FormatError, read_recording};
use crate::text::{grouped, printable};

/// Bytes that are read at a time.
const BUFFER: usize = 1 << 20;

/// The most topics with clouds.
const MAX_TOPICS: usize = 4096;

/// What was found on one topic.
#[derive(Default)]
struct Topic {
    /// The folder of its sweeps in the output.
    folder: PathBuf,
    messages: usize,
    sweeps: usize,
    points: usize,
    dropped: usize,
    timed: usize,
    /// Why the times of the points of a sweep are not used.
    refused_times: Option<String>,
    /// Times of the sweeps, nanoseconds: the names of their files.
    stamps: HashSet<u64>,
    /// Messages with the time of an earlier one, which were left out.
    repeated: usize,
}

impl Unpack {
    pub(super) fn recording(&self, file: File, length: u64) -> Result<(), Failure> {
        let bar = bar(
            length,
            "{wide_bar:.cyan/blue} {bytes} of {total_bytes}  {eta} left",
        );
        let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
        let mut folders = HashSet::new();
        let mut damaged = 0;
        let mut failure = None;
        let bytes = bar.wrap_read(BufReader::with_capacity(BUFFER, file));
        let read = read_recording(bytes, |message| {
            if self
                .topic
                .as_ref()
                .is_some_and(|topic| topic != message.topic)
            {
                return ControlFlow::Continue(());
            }
            if topics.len() >= MAX_TOPICS && !topics.contains_key(message.topic) {
                let text = format!("it has more than {MAX_TOPICS} topics");
                failure = Some(Failure::bad_input(anyhow!(text)));
                return ControlFlow::Break(());
            }
            let topic = topics
                .entry(message.topic.to_owned())
                .or_insert_with(|| Topic {
                    folder: Self::folder(message.topic, &mut folders),
                    ..Topic::default()
                });
            topic.messages += 1;
            let limit = self.limit.unwrap_or(usize::MAX);
            if topic.sweeps >= limit && self.topic.is_some() {
                return ControlFlow::Break(());
            }
            if self.list || topic.messages <= self.skip || topic.sweeps >= limit {
                return ControlFlow::Continue(());
            }
            match self.write(message, topic) {
                Ok(()) => ControlFlow::Continue(()),
                Err(Stop::Damaged(error)) => {
                    damaged += 1;
                    bar.suspend(|| leave_out(message, &error));
                    ControlFlow::Continue(())
                }
                Err(Stop::Failed(error)) => {
                    failure = Some(error);
                    ControlFlow::Break(())
                }
            }
        });
        bar.finish_and_clear();
        if let Some(failure) = failure {
            return Err(failure);
        }
        let read = read
            .with_context(|| self.file.display().to_string())
            .map_err(Failure::bad_input);
        if topics.is_empty() {
            return read.and_then(|()| Err(self.nothing_found()));
        }
        self.report(&topics)?;
        read?;
        if damaged > 0 {
            let message = format!("{damaged} clouds cannot be read; the others are written");
            return Err(Failure::bad_input(anyhow!(message)));
        }
        Ok(())
    }

    /// Writes one sweep.
    fn write(&self, message: &CloudMessage<'_>, topic: &mut Topic) -> Result<(), Stop> {
        let sweep = message.sweep().map_err(Stop::Damaged)?;
        let stamp = match sweep.stamp_ns {
            0 => message.logged_ns,
            stamp => stamp,
        };
        if topic.stamps.contains(&stamp) {
            topic.repeated += 1;
            return Ok(());
        }
        let name = topic.folder.join(format!("{stamp:019}.pcd"));
        write_sweep(self.output(), &name, &sweep.points, sweep.times.as_ref())
            .map_err(Stop::Failed)?;
        topic.stamps.insert(stamp);
        topic.sweeps += 1;
        topic.points += sweep.points.len();
        topic.dropped += sweep.dropped;
        topic.timed += usize::from(sweep.times.is_some());
        topic.refused_times = topic.refused_times.take().or(sweep.refused_times);
        Ok(())
    }

    /// The folder of a topic's sweeps in the output, which is none of the others `taken`.
    fn folder(topic: &str, taken: &mut HashSet<String>) -> PathBuf {
        let plain = folder_of(topic);
        let mut name = plain.clone();
        for number in 2.. {
            if taken.insert(name.clone()) {
                break;
            }
            name = format!("{plain}.{number}");
        }
        name.into()
    }

    fn nothing_found(&self) -> Failure {
        let message = match &self.topic {
            None => "no clouds of sensor_msgs/PointCloud2 are in it".to_owned(),
            Some(topic) => {
                format!("no clouds are on the topic {topic}; --list shows the topics")
            }
        };
        let message = format!("{}: {message}", self.file.display());
        Failure::bad_input(anyhow!(message))
    }

    fn report(&self, topics: &BTreeMap<String, Topic>) -> Result<(), Failure> {
        for (name, topic) in topics {
            if self.list {
                say(format_args!("{name}: {} clouds", grouped(topic.messages)))?;
                continue;
            }
            say(format_args!(
                "{name}: {} sweeps, {} points, in {}",
                grouped(topic.sweeps),
                grouped(topic.points),
                self.output().join(&topic.folder).display()
            ))?;
            if topic.dropped > 0 {
                let dropped = grouped(topic.dropped);
                say(format_args!(
                    "  {dropped} points without finite coordinates are left out"
                ))?;
            }
            if topic.repeated > 0 {
                let repeated = grouped(topic.repeated);
                say(format_args!(
                    "  {repeated} clouds with the time of an earlier one are left out"
                ))?;
            }
            match &topic.refused_times {
                Some(why) => say(format_args!(
                    "  the times of the points are not used: {why}"
                ))?,
                None if topic.timed > 0 => say(format_args!("  with the times of the points"))?,
                None => {}
            }
        }
        Ok(())
    }
}

/// Why a sweep was not written.
enum Stop {
    Damaged(FormatError),
    Failed(Failure),
}

fn leave_out(message: &CloudMessage<'_>, error: &FormatError) {
    let (topic, logged) = (printable(message.topic), message.logged_ns);
    complain(format_args!(
        "the cloud on {topic} of {logged} ns is left out: {error}"
    ));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_whose_plain_names_are_the_same_have_folders_of_their_own() {
        let mut taken = HashSet::new();
        let folders = ["/lidar/top", "/lidar_top", "/lidar/low", "/lidar top"]
            .map(|topic| Unpack::folder(topic, &mut taken));
        let expected = ["lidar_top", "lidar_top.2", "lidar_low", "lidar_top.3"];
        assert_eq!(folders, expected.map(PathBuf::from));
    }
}
