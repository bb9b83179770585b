//! Reading and writing of a run, with patience for stores that fail.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use bytes::Bytes;
use tokio::runtime::Runtime;

use super::places::{PlaceError, Places};
use super::report::{Outcome, RowReport};
use super::types::Inputs;
use crate::flow::{Point, Sweep};
use crate::formats::{FormatError, PointTimes, SweepClock, read_timed_cloud};

/// Times that a store is asked before a pair has failed.
const ATTEMPTS: u32 = 4;

/// A pair to label.
#[derive(Clone, Debug)]
pub(super) struct Wanted {
    pub(super) drive: usize,
    pub(super) pair: usize,
    /// The name of its output.
    pub(super) path: String,
    pub(super) before: Before,
}

/// What is there of a pair's output before it is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Before {
    /// Nothing.
    Nothing,
    /// The output: the pair is computed for the tracks of its drive alone.
    Output,
    /// Nothing, because an earlier run could not label the pair: the tracks of its drive end before it.
    /// They are removed before its output is written.
    Gap,
    /// An output that may lack the motions of tracks: a pair before it was not labelled, or its drive
    /// has no tracks yet. It is replaced.
    Untracked,
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

impl Io<'_> {
    /// Reads a sweep. A store that fails is asked again after a pause.
    pub(super) fn read(&self, places: &Places, uri: &str) -> Result<Loaded, Unread> {
        let bytes = self.patiently(|| self.runtime.block_on(places.read(uri)));
        let bytes = bytes.map_err(|error| Unread {
            may_pass: error.may_pass(),
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
            times: read.times.map(|times| times.offsets_s),
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

    /// Writes an output, unless it is there and not to be replaced, and returns its report.
    pub(super) fn write(&self, output: Output) -> RowReport {
        let bytes = match output.bytes {
            Err(error) => return output.report.ended(Outcome::Refused, &error),
            Ok(bytes) => Bytes::from(bytes),
        };
        let place = &self.inputs.output;
        if let Some(path) = &output.removes {
            match self.patiently(|| self.runtime.block_on(place.remove(path))) {
                Ok(()) | Err(PlaceError::Missing(_)) => {}
                Err(error) => return output.report.ended(Outcome::Failed, &error),
            }
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
        let mut report = output.report;
        match self.patiently(put) {
            Ok(true) => report.outcome = Outcome::Labelled,
            Ok(false) => report.outcome = Outcome::Raced,
            Err(error) => return report.ended(Outcome::of_trouble(error.may_pass()), &error),
        }
        report
    }
}
