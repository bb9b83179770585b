//! Reading and writing of a run, with patience for stores that fail.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use bytes::Bytes;
use tokio::runtime::Runtime;

use super::layout::left_out_path;
use super::places::{PlaceError, Places};
use super::report::{Outcome, RowReport};
use super::types::Inputs;
use crate::flow::{Point, Sweep};
use crate::formats::{FormatError, PointTimes, SweepClock, read_timed_cloud, sweep_time_s};

/// Times that a store is asked before a pair has failed.
const ATTEMPTS: u32 = 4;

/// A pair to label.
#[derive(Clone, Debug)]
pub(super) struct Wanted {
    pub(super) drive: usize,
    pub(super) pair: usize,
    /// The name of its output.
    pub(super) path: String,
    /// Whether its output is there.
    pub(super) is_there: bool,
    /// Whether the mark is there that its output is to be replaced.
    pub(super) is_marked: bool,
    /// Whether the tracks of its drive are there.
    pub(super) has_tracks: bool,
}

/// A sweep of the plan: the indices of its drive and of the sweep.
pub(super) type At = (usize, usize);

/// A sweep that was read.
pub(super) struct Loaded {
    pub(super) sweep: Sweep,
    pub(super) points: Arc<[Point]>,
    pub(super) clock: Option<SweepClock>,
}

/// Why a sweep was not read.
#[derive(Clone, Debug)]
pub(super) struct Unread {
    pub(super) reason: String,
    pub(super) may_pass: bool,
}

/// An output to be written.
pub(super) struct Output {
    /// The index of its drive.
    pub(super) drive: usize,
    pub(super) path: String,
    /// Whether it replaces an output that is there.
    pub(super) replaces: bool,
    /// A file that is removed before.
    pub(super) removes: Option<String>,
    /// Whether the mark is there that it is to be replaced.
    pub(super) is_marked: bool,
    pub(super) bytes: Result<Vec<u8>, FormatError>,
    pub(super) report: RowReport,
}

/// The stores of a run.
#[derive(Clone, Copy)]
pub(super) struct Io<'a> {
    pub(super) inputs: &'a Inputs<'a>,
    pub(super) runtime: &'a Runtime,
    pub(super) stop: &'a AtomicBool,
}

/// The text of a mark: which sweeps could not be read, and why.
pub(super) fn mark_text(left_out: &[String]) -> String {
    left_out.join("\n") + "\n"
}

impl Io<'_> {
    /// Reads a sweep. A store that fails is asked again after a pause. `time_s` is its time, where the
    /// plan has one for all sweeps of its drive.
    pub(super) fn read(
        &self,
        places: &Places,
        uri: &str,
        time_s: Option<f64>,
    ) -> Result<Loaded, Unread> {
        let bytes = self.patiently(|| self.runtime.block_on(places.read(uri)));
        let bytes = bytes.map_err(|error| Unread {
            // A node may lack the variables of a bucket that others have.
            may_pass: error.may_pass() || matches!(error, PlaceError::Bucket(_)),
            reason: error.to_string(),
        })?;
        let name = uri.rsplit('/').next();
        let read = read_timed_cloud(&bytes, name).map_err(|error| Unread {
            may_pass: false,
            reason: format!("{uri}: {error}"),
        })?;
        let clock = read.times.as_ref().map(PointTimes::clock);
        let sweep = Sweep {
            points: read.cloud.points,
            ground: None,
            time_s: time_s.or_else(|| sweep_time_s(uri, clock)),
            times: read
                .times
                .filter(|_| !self.inputs.ignore_times)
                .map(|times| times.offsets_s),
        };
        Ok(Loaded {
            points: sweep.points.as_slice().into(),
            sweep,
            clock,
        })
    }

    /// Does `work` again, after pauses, while its store fails.
    pub(super) fn patiently<T>(
        &self,
        work: impl Fn() -> Result<T, PlaceError>,
    ) -> Result<T, PlaceError> {
        let mut attempt = 1;
        loop {
            match work() {
                Err(error) if error.may_pass() && attempt < ATTEMPTS => {
                    let is_stopping = self.stop.load(Ordering::Relaxed);
                    if is_stopping {
                        return Err(error);
                    }
                    thread::sleep(Duration::from_millis(200) * 4u32.pow(attempt - 1));
                    attempt += 1;
                }
                done => return done,
            }
        }
    }

    /// Writes the mark of a label: another run is to label its pair again. `text` says why.
    pub(super) fn mark(&self, path: &str, text: &str) -> Result<(), PlaceError> {
        let (place, mark) = (&self.inputs.output, left_out_path(path));
        let bytes = Bytes::from(text.to_owned());
        self.patiently(|| self.runtime.block_on(place.put(&mark, bytes.clone())))
    }

    /// Writes an output, unless it is there and not to be replaced, and returns its report.
    pub(super) fn write(&self, output: Output) -> RowReport {
        let bytes = match output.bytes {
            Err(error) => return output.report.ended(Outcome::Refused, &error),
            Ok(bytes) => Bytes::from(bytes),
        };
        let place = &self.inputs.output;
        let remove = |path: &str| match self.patiently(|| self.runtime.block_on(place.remove(path)))
        {
            Err(PlaceError::Missing(_)) => Ok(()),
            removed => removed,
        };
        let mark = left_out_path(&output.path);
        let left_out = &output.report.left_out;
        // The mark is there whenever the label is.
        let prepared = output.removes.as_deref().map_or(Ok(()), remove);
        let prepared = prepared.and_then(|()| match left_out.is_empty() {
            true => Ok(()),
            false => {
                // Until the label is replaced, the mark is none that another run takes for its own.
                let unfinished = if output.replaces { "replaced:\n" } else { "" };
                self.mark(
                    &output.path,
                    &(unfinished.to_owned() + &mark_text(left_out)),
                )
            }
        });
        if let Err(error) = prepared {
            return output
                .report
                .ended(Outcome::of_trouble(error.may_pass()), &error);
        }
        let put = || {
            let (path, bytes) = (&output.path, bytes.clone());
            self.runtime.block_on(async {
                match output.replaces {
                    true => place.put(path, bytes).await.map(|()| true),
                    false => place.put_new(path, bytes).await,
                }
            })
        };
        let written = self.patiently(put).and_then(|is_new| {
            // The label of another process may lack it.
            if is_new && output.is_marked && left_out.is_empty() {
                remove(&mark)?;
            } else if output.replaces && !left_out.is_empty() {
                self.mark(&output.path, &mark_text(left_out))?;
            }
            Ok(is_new)
        });
        let mut report = output.report;
        match written {
            Ok(true) => report.outcome = Outcome::Labelled,
            Ok(false) => report.outcome = Outcome::Raced,
            Err(error) => return report.ended(Outcome::of_trouble(error.may_pass()), &error),
        }
        report
    }
}
