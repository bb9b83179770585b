//! The pipeline of a shard: sweeps are read ahead and outputs are written behind, while a pair is
//! estimated.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::runtime::Runtime;

use super::places::{PlaceError, Places};
use super::report::{Outcome, RowReport, lines};
use super::run::{Done, Inputs, LabelError, Solver, Told, tracks_path};
use crate::flow::tracks::{ClusteredSweep, Tracker, correct};
use crate::flow::{Control, Ego, Estimate, FlowError, Point, Sweep, WindowedPair, window};
use crate::formats::{
    FormatError, PointTimes, SweepClock, pair_interval_s, read_av2_mask, read_timed_cloud,
    write_tracks,
};
use crate::job::JobOptions;

/// Sweeps that are read ahead.
const AHEAD: usize = 6;
/// Outputs that wait to be written.
const BEHIND: usize = 4;
/// How often the report is written.
const REPORT_EVERY: Duration = Duration::from_secs(30);
/// Times that a store is asked before a pair has failed.
const ATTEMPTS: u32 = 4;

/// A pair to label.
#[derive(Clone, Debug)]
pub(super) struct Wanted {
    pub(super) drive: usize,
    pub(super) pair: usize,
    /// The name of its output.
    pub(super) path: String,
    /// Whether its output is there: then it is computed for the tracks alone.
    pub(super) is_there: bool,
}

/// A sweep of the plan: the indices of its drive and of the sweep.
type At = (usize, usize);

/// A sweep that was read.
struct Loaded {
    sweep: Sweep,
    points: Arc<[Point]>,
    clock: Option<SweepClock>,
}

/// Why a sweep was not read.
#[derive(Clone, Debug)]
struct Unread {
    reason: String,
    may_pass: bool,
}

/// An output to be written.
struct Output {
    path: String,
    bytes: Result<Vec<u8>, FormatError>,
    report: RowReport,
}

pub(super) struct Pipeline<'a> {
    pub(super) inputs: &'a Inputs<'a>,
    pub(super) runtime: &'a Runtime,
    pub(super) wanted: &'a [Wanted],
    /// Pairs of the shard.
    pub(super) total: usize,
    pub(super) stop: &'a AtomicBool,
}

impl Pipeline<'_> {
    pub(super) fn run(
        &self,
        solver: &mut dyn Solver,
        control: &dyn Control,
        told: &mut dyn FnMut(&Told),
    ) -> Result<Done, LabelError> {
        let (sweeps, read) = sync_channel(AHEAD);
        let (outputs, to_write) = sync_channel(BEHIND);
        let (reports, reported) = sync_channel(self.wanted.len() + 1);
        thread::scope(|scope| {
            scope.spawn(move || self.read_ahead(&sweeps));
            let writing = reports.clone();
            scope.spawn(move || self.write_behind(&to_write, &writing));
            let mut estimates = Estimates {
                of: self,
                read,
                held: BTreeMap::new(),
                outputs,
                reports,
                tracking: Tracking::NotBegun,
            };
            let mut tally = Tally::new(self, &reported);
            for wanted in self.wanted {
                if self.stop.load(Ordering::Relaxed) {
                    tally.done.stopped = true;
                    break;
                }
                estimates.label(wanted, solver, control);
                tally.take(told);
            }
            // The reader stops when nobody takes its sweeps, and the writer when nothing comes.
            drop(estimates);
            tally.finish(told)
        })
    }

    /// Reads the sweeps of all windows, each once, in the order in which they are needed.
    fn read_ahead(&self, sweeps: &SyncSender<(At, Result<Loaded, Unread>)>) {
        let places = Places::default();
        let size = self.inputs.options.solver_options(0).sweeps();
        let mut next: HashMap<usize, usize> = HashMap::new();
        for wanted in self.wanted {
            let drive = &self.inputs.plan.drives()[wanted.drive];
            let next = next.entry(wanted.drive).or_insert(0);
            for index in window(wanted.pair, drive.sweeps.len(), size) {
                if index < *next {
                    continue;
                }
                *next = index + 1;
                let loaded = self.read(&places, &drive.sweeps[index].uri);
                if sweeps.send(((wanted.drive, index), loaded)).is_err() {
                    return;
                }
            }
        }
    }

    /// Reads a sweep. A store that fails is asked again after a pause.
    fn read(&self, places: &Places, uri: &str) -> Result<Loaded, Unread> {
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
    fn patiently<T>(&self, work: impl Fn() -> Result<T, PlaceError>) -> Result<T, PlaceError> {
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

    /// Writes the outputs, each unless it is there.
    fn write_behind(&self, outputs: &Receiver<Output>, reports: &SyncSender<RowReport>) {
        while let Ok(output) = outputs.recv() {
            let report = match output.bytes {
                Err(error) => output.report.ended(Outcome::Refused, &error),
                Ok(bytes) => {
                    let bytes = Bytes::from(bytes);
                    let place = &self.inputs.output;
                    let put = || {
                        self.runtime
                            .block_on(place.put_new(&output.path, bytes.clone()))
                    };
                    let mut report = output.report;
                    match self.patiently(put) {
                        Ok(true) => report.outcome = Outcome::Labelled,
                        Ok(false) => report.outcome = Outcome::Raced,
                        Err(error) => report = report.ended(Outcome::Failed, &error),
                    }
                    report
                }
            };
            let _the_tally_is_there = reports.send(report);
        }
    }
}

/// The estimates, in order, with the sweeps that they need.
struct Estimates<'a> {
    of: &'a Pipeline<'a>,
    read: Receiver<(At, Result<Loaded, Unread>)>,
    held: BTreeMap<At, Result<Loaded, Unread>>,
    outputs: SyncSender<Output>,
    reports: SyncSender<RowReport>,
    tracking: Tracking,
}

/// The tracks of the drive that is being labelled.
#[derive(Default)]
enum Tracking {
    /// No pair of the drive was estimated yet.
    #[default]
    NotBegun,
    /// All pairs so far have an estimate.
    Begun(Box<Tracker>),
    /// A pair has no estimate: the tracks end before it.
    Ended,
}

impl Estimates<'_> {
    fn label(&mut self, wanted: &Wanted, solver: &mut dyn Solver, control: &dyn Control) {
        let inputs = self.of.inputs;
        let drive = &inputs.plan.drives()[wanted.drive];
        let [source, target] = [wanted.pair, wanted.pair + 1].map(|at| &drive.sweeps[at].uri);
        let mut report = RowReport::new(drive.key(wanted.pair), source, target);
        let done = self.estimate(wanted, solver, control, &mut report);
        if let Err((outcome, reason)) = done {
            let _the_tally_is_there = self.reports.send(report.ended(outcome, &reason));
            if inputs.tracks {
                let tracking = std::mem::replace(&mut self.tracking, Tracking::Ended);
                self.write_tracks_of(wanted.drive, tracking);
            }
        }
        if inputs.tracks && wanted.pair + 1 == drive.pairs() {
            let tracking = std::mem::take(&mut self.tracking);
            self.write_tracks_of(wanted.drive, tracking);
        }
    }

    fn estimate(
        &mut self,
        wanted: &Wanted,
        solver: &mut dyn Solver,
        control: &dyn Control,
        report: &mut RowReport,
    ) -> Result<(), (Outcome, String)> {
        let inputs = self.of.inputs;
        let drive = &inputs.plan.drives()[wanted.drive];
        let count = drive.sweeps.len();
        let size = inputs.options.solver_options(0).sweeps();
        self.gather(wanted, count, size);
        let at = |index: usize| self.held.get(&(wanted.drive, index));
        let loaded = |index: usize| at(index).and_then(|loaded| loaded.as_ref().ok());
        for index in window(wanted.pair, count, size) {
            let Some(Err(unread)) = at(index) else {
                continue;
            };
            if index == wanted.pair || index == wanted.pair + 1 {
                let outcome = match unread.may_pass {
                    true => Outcome::Failed,
                    false => Outcome::Refused,
                };
                return Err((outcome, unread.reason.clone()));
            }
            report.left_out.push(unread.reason.clone());
        }
        let mask = self.mask(wanted)?;
        let pair = [wanted.pair, wanted.pair + 1];
        let [source, target] = pair.map(|index| loaded(index).expect("both sweeps were read"));
        let options = self.options(wanted, [source.clock, target.clock]);
        let larger = source.points.len().max(target.points.len());
        let mut solver_options = options.solver_options(larger);
        if inputs.poses {
            let poses = pair.map(|index| drive.sweeps[index].pose.unwrap_or_default());
            solver_options.ego = Ego::Given(poses[1].inv_mul(&poses[0]));
        }
        let windowed = WindowedPair {
            pair: wanted.pair,
            count,
            sweeps: size,
            before: None,
        };
        let sweep = |index: usize| Some(&loaded(index)?.sweep);
        let solved =
            solver.solve(&|backend| windowed.estimate(backend, sweep, &solver_options, control));
        let mut estimate = solved.map_err(|error| failed(&error))?;
        let [source, target] = estimate.sweeps([&source.points, &target.points]);
        if inputs.tracks {
            if matches!(self.tracking, Tracking::NotBegun) {
                self.tracking = Tracking::Begun(Box::default());
            }
            if let Tracking::Begun(tracker) = &mut self.tracking {
                let dt_s = solver_options.dt_s;
                let refused = |error: &dyn ToString| (Outcome::Refused, error.to_string());
                let sweep = ClusteredSweep::new(&source, &estimate, dt_s);
                let sweep = sweep.map_err(|error| refused(&error))?;
                let tracked = tracker.push(&sweep).map_err(|error| refused(&error))?;
                correct(&mut estimate, [&source, &target], &tracked, dt_s);
            }
        }
        if wanted.is_there {
            return Ok(());
        }
        self.put(wanted, &source, &estimate, mask.as_deref(), report.clone());
        Ok(())
    }

    /// Takes the sweeps of a window, and drops those that no later pair needs.
    fn gather(&mut self, wanted: &Wanted, count: usize, size: usize) {
        let range = window(wanted.pair, count, size);
        self.held = self.held.split_off(&(wanted.drive, range.start));
        let last = (wanted.drive, range.end - 1);
        while !self.held.contains_key(&last) {
            let Ok((at, mut loaded)) = self.read.recv() else {
                break;
            };
            if let Ok(loaded) = &mut loaded {
                let sweep = std::mem::take(&mut loaded.sweep);
                loaded.sweep = sweep.prepared(&self.of.inputs.options.solver_options(usize::MAX));
            }
            self.held.insert(at, loaded);
        }
    }

    /// The rows that the layout asks for.
    fn mask(&self, wanted: &Wanted) -> Result<Option<Vec<bool>>, (Outcome, String)> {
        let Some(masks) = &self.of.inputs.masks else {
            return Ok(None);
        };
        let read = || self.of.runtime.block_on(masks.read(&wanted.path));
        let bytes = self.of.patiently(read).map_err(|error| {
            let outcome = match error.may_pass() {
                true => Outcome::Failed,
                false => Outcome::Refused,
            };
            (outcome, format!("its mask: {error}"))
        })?;
        let mask = read_av2_mask(&bytes);
        mask.map(Some)
            .map_err(|error| (Outcome::Refused, format!("its mask: {error}")))
    }

    /// The options of a pair, with the time between its sweeps.
    fn options(&self, wanted: &Wanted, clocks: [Option<SweepClock>; 2]) -> JobOptions {
        let mut options = self.of.inputs.options.clone();
        let sweeps = &self.of.inputs.plan.drives()[wanted.drive].sweeps[wanted.pair..];
        let times = sweeps[0].time_s.zip(sweeps[1].time_s);
        let apart = times.map(|(source, target)| (target - source).abs() as f32);
        let names = [&sweeps[0].uri, &sweeps[1].uri].map(String::as_str);
        options.dt_s = options
            .dt_s
            .or(apart.filter(|&apart| apart > 0.0 && apart <= crate::job::MAX_DT_S))
            .or_else(|| pair_interval_s(names, clocks));
        options
    }

    fn put(
        &self,
        wanted: &Wanted,
        source: &[Point],
        estimate: &Estimate,
        mask: Option<&[bool]>,
        report: RowReport,
    ) {
        let output = Output {
            path: wanted.path.clone(),
            bytes: self.of.inputs.layout.bytes(source, estimate, mask),
            report: report.with(estimate),
        };
        let _the_writer_is_there = self.outputs.send(output);
    }

    /// Writes the tracks of a drive. They were written before if they have ended.
    fn write_tracks_of(&self, drive: usize, tracking: Tracking) {
        let tracker = match tracking {
            Tracking::NotBegun => Tracker::default(),
            Tracking::Begun(tracker) => *tracker,
            Tracking::Ended => return,
        };
        let name = &self.of.inputs.plan.drives()[drive].name;
        let mut bytes = Vec::new();
        let written = write_tracks(&tracker.finish(), &mut bytes);
        let path = tracks_path(name);
        let _the_writer_is_there = self.outputs.send(Output {
            report: RowReport::new(path.clone(), name, name),
            path,
            bytes: written.map(|()| bytes),
        });
    }
}

/// What became of a pair whose estimate failed.
fn failed(error: &FlowError) -> (Outcome, String) {
    let outcome = match error.is_input() {
        true => Outcome::Refused,
        false => Outcome::Failed,
    };
    (outcome, error.to_string())
}

/// Counts the reports, and writes them from time to time.
struct Tally<'a> {
    of: &'a Pipeline<'a>,
    reported: &'a Receiver<RowReport>,
    reports: Vec<RowReport>,
    done: Done,
    began: Instant,
    written: Instant,
    path: String,
}

impl<'a> Tally<'a> {
    fn new(of: &'a Pipeline<'a>, reported: &'a Receiver<RowReport>) -> Self {
        let shard = of.inputs.shard;
        let attempt = uuid::Uuid::now_v7();
        let waiting = of.wanted.iter().filter(|wanted| !wanted.is_there).count();
        Self {
            of,
            reported,
            reports: Vec::new(),
            done: Done {
                pairs: of.total,
                found: of.total - waiting,
                ..Done::default()
            },
            began: Instant::now(),
            written: Instant::now(),
            path: format!("_report/{attempt}-{}-of-{}.jsonl", shard.index, shard.count),
        }
    }

    fn take(&mut self, told: &mut dyn FnMut(&Told)) {
        let mut is_new = false;
        while let Ok(report) = self.reported.try_recv() {
            self.count(report);
            is_new = true;
        }
        if is_new {
            told(&self.told());
        }
        if self.written.elapsed() > REPORT_EVERY {
            self.written = Instant::now();
            // The last report says it if the store does not take this one.
            let _a_later_one_may_be_taken = self.write();
        }
    }

    fn count(&mut self, report: RowReport) {
        let is_pair = !report.key.ends_with("tracks.json");
        match report.outcome {
            Outcome::Labelled => self.done.labelled += usize::from(is_pair),
            Outcome::Raced => self.done.raced += usize::from(is_pair),
            Outcome::Refused => self.done.refused += 1,
            Outcome::Failed => self.done.failed += 1,
        }
        if !report.is_there() {
            self.done.troubles.push(report.clone());
        }
        self.reports.push(report);
    }

    fn told(&self) -> Told {
        let done = &self.done;
        let own = done.labelled + done.raced + done.refused + done.failed;
        let rate = own as f64 / self.began.elapsed().as_secs_f64().max(1e-9);
        let left = done.pairs.saturating_sub(done.found + own);
        Told {
            done: done.found + own - done.failed,
            total: done.pairs,
            refused: done.refused,
            pairs_per_second: rate,
            seconds_left: left as f64 / rate.max(1e-9),
        }
    }

    fn write(&self) -> Result<(), PlaceError> {
        if self.reports.is_empty() {
            return Ok(());
        }
        let bytes = Bytes::from(lines(&self.reports));
        let output = &self.of.inputs.output;
        let put = || {
            self.of
                .runtime
                .block_on(output.put(&self.path, bytes.clone()))
        };
        self.of.patiently(put)
    }

    /// Waits for the outputs that are being written, and writes the last report.
    fn finish(mut self, told: &mut dyn FnMut(&Told)) -> Result<Done, LabelError> {
        while let Ok(report) = self.reported.recv() {
            self.count(report);
            told(&self.told());
        }
        self.write()?;
        Ok(self.done)
    }
}
