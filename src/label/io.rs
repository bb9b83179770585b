//! Reading and writing of a run, with patience for stores that fail.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use bytes::Bytes;
use tokio::runtime::Runtime;

use super::layout::left_out_path;
use super::places::{PlaceError, Places, path_of};
use super::report::{Outcome, RowReport};
use super::types::Inputs;
use crate::flow::{Point, Sweep};
use crate::formats::{FormatError, SweepClock, read_timed_cloud, sweep_time_s};

/// Begins a mark while its label is replaced, so that another run does not take the mark for its own.
const UNFINISHED: &str = "replaced:\n";

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
    /// Why the times of its points are not used, and its URI.
    pub(super) refused_times: Option<String>,
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
    /// The index of the drive that is left to the next run, see [`Tracking::Failed`]: its other sweeps are not
    /// read.
    ///
    /// [`Tracking::Failed`]: super::estimates::Tracking::Failed
    pub(super) left_alone: &'a AtomicUsize,
}

/// Does the work of one sweep or pair: a panic must not end the others.
///
/// # Errors
/// A text that says that `what` has panicked.
pub(super) fn isolated<T>(what: &str, work: impl FnOnce() -> T) -> Result<T, String> {
    let done = catch_unwind(AssertUnwindSafe(work));
    done.map_err(|_| format!("{what} has panicked: this is a defect of the program"))
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
        let path = path_of(uri);
        let name = path.rsplit('/').next();
        let read = isolated("its reader", || read_timed_cloud(&bytes, name));
        let read = read.and_then(|read| read.map_err(|error| error.to_string()));
        let read = read.map_err(|reason| Unread {
            may_pass: false,
            reason: format!("{uri}: {reason}"),
        })?;
        let clock = read.clock;
        let sweep = Sweep {
            points: read.cloud.points,
            ground: None,
            time_s: time_s.or_else(|| sweep_time_s(&path, clock)),
            times: read
                .times
                .filter(|_| !self.inputs.ignore_times)
                .map(|times| times.offsets_s),
        };
        Ok(Loaded {
            points: sweep.points.as_slice().into(),
            sweep,
            clock,
            refused_times: read.refused_times.map(|reason| format!("{uri}: {reason}")),
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

    fn remove(&self, path: &str) -> Result<(), PlaceError> {
        match self.patiently(|| self.runtime.block_on(self.inputs.output.remove(path))) {
            Err(PlaceError::Missing(_)) => Ok(()),
            removed => removed,
        }
    }

    /// Removes the mark of a label that this process has replaced by `bytes`. Another process, which could not
    /// read a sweep, may have replaced it since: then the mark stays.
    fn unmark(&self, path: &str, bytes: &Bytes) -> Result<(), PlaceError> {
        self.remove(&left_out_path(path))?;
        let kept = self.patiently(|| self.runtime.block_on(self.inputs.output.read(path)));
        match kept {
            Ok(kept) if kept == *bytes => Ok(()),
            kept => self.mark(path, UNFINISHED).and(kept.map(drop)),
        }
    }

    /// Writes an output, unless it is there and not to be replaced, and returns its report.
    pub(super) fn write(&self, output: Output) -> RowReport {
        let bytes = match output.bytes {
            Err(error) => return output.report.ended(Outcome::Refused, &error),
            Ok(bytes) => Bytes::from(bytes),
        };
        let place = &self.inputs.output;
        let left_out = &output.report.left_out;
        // The mark is there whenever the label is.
        let removes = output.removes.as_deref();
        let prepared = removes.map_or(Ok(()), |path| self.remove(path));
        let prepared = prepared.and_then(|()| match left_out.is_empty() {
            true => Ok(()),
            false => {
                let unfinished = if output.replaces { UNFINISHED } else { "" };
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
            // The label of another process may lack a sweep.
            if is_new && output.is_marked && left_out.is_empty() {
                self.unmark(&output.path, &bytes)?;
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

#[cfg(test)]
mod tests {
    use super::super::manifest::read_manifest;
    use super::super::places::Place;
    use super::super::plan::Plan;
    use super::*;
    use crate::job::JobOptions;

    #[test]
    fn a_mark_stays_where_another_process_has_replaced_the_label_since() {
        const PATH: &str = "d/0.npz";
        let folder = tempfile::tempdir().expect("a folder");
        let place = Place::open(&folder.path().to_string_lossy()).expect("a place");
        let manifest = "drive,sweep\nd,0.pcd\nd,1.pcd\n";
        let drives = read_manifest(manifest.into(), None).expect("a drive");
        let plan = Plan::new(drives).expect("a plan");
        let options = JobOptions::default();
        let inputs = Inputs::new(&plan, &options, place.clone());
        let runtime = Runtime::new().expect("a runtime");
        let io = Io {
            inputs: &inputs,
            runtime: &runtime,
            stop: &AtomicBool::new(false),
            left_alone: &AtomicUsize::new(usize::MAX),
        };
        let whole = Bytes::from("of all sweeps");
        for (there, is_marked) in [("of all sweeps", false), ("without a sweep", true)] {
            io.mark(PATH, "1.pcd is not there\n").expect("written");
            let put = place.put(PATH, there.into());
            runtime.block_on(put).expect("written");
            io.unmark(PATH, &whole).expect("no failure");
            let mark = runtime.block_on(place.read(&left_out_path(PATH)));
            assert_eq!(mark.is_ok(), is_marked, "{there}");
        }
    }
}
