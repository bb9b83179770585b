//! The estimates of a shard, pair by pair.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, Sender, SyncSender};

use super::io::{At, Io, Loaded, Output, Unread, Wanted, isolated, mark_text};
use super::layout::{left_out_path, tracks_path};
use super::places::path_of;
use super::report::{Outcome, RowReport};
use super::types::Solver;
use crate::flow::tracks::{Tracker, push_and_correct};
use crate::flow::{
    Control, Estimate, FlowError, Method, Options, Point, Problem, Sweep, WindowedPair,
    neighbor_cost, predict_cost, window,
};
use crate::formats::{SweepClock, is_interval, pair_interval_s, read_av2_mask, write_tracks};

/// Upper bounds of the memory of an object search: bytes of any, and bytes for each point of both sweeps.
const MIN_BYTES: usize = 64 << 20;
const OBJECT_BYTES: usize = 640;

/// The estimates, in order, with the sweeps that they need.
pub(super) struct Estimates<'a> {
    pub(super) io: &'a Io<'a>,
    pub(super) read: Receiver<(At, Result<Loaded, Unread>)>,
    pub(super) held: BTreeMap<At, Result<Loaded, Unread>>,
    pub(super) outputs: SyncSender<Output>,
    pub(super) reports: Sender<RowReport>,
    pub(super) tracking: Tracking,
    /// The drive whose output was written last in this run.
    pub(super) changed: Option<usize>,
}

/// The tracks of the drive that is being labelled.
#[derive(Default)]
pub(super) enum Tracking {
    /// No pair of the drive was estimated yet.
    #[default]
    NotBegun,
    /// All pairs so far have an estimate.
    Begun(Box<Tracker>),
    /// A pair is refused: the tracks end before it. They are written at the end of the drive.
    Ended(Box<Output>),
    /// A pair of this drive has failed. The next run begins the drive again, so that its tracks and
    /// flows do not depend on whether a store failed for a while.
    Failed(usize),
}

impl Estimates<'_> {
    /// Labels a pair: its output goes to the writer, a failure to the reports.
    pub(super) fn label(
        &mut self,
        wanted: &Wanted,
        solver: &mut dyn Solver,
        control: &dyn Control,
    ) {
        let inputs = self.io.inputs;
        let drive = &inputs.plan.drives()[wanted.drive];
        match self.tracking {
            Tracking::Failed(failed) if failed == wanted.drive => return,
            Tracking::Failed(_) => self.tracking = Tracking::NotBegun,
            _ => {}
        }
        let [source, target] = [wanted.pair, wanted.pair + 1].map(|at| &drive.sweeps[at].uri);
        let mut report = RowReport {
            was_there: wanted.is_there,
            ..RowReport::new(drive.key(wanted.pair), source, target)
        };
        let done = self.estimate(wanted, solver, control, &mut report);
        if let Err((mut outcome, reason)) = done {
            // The tracks end before this pair, though its label is there.
            let ends_tracks = inputs.tracks && outcome == Outcome::Refused && wanted.is_there;
            if ends_tracks && !wanted.is_marked && self.io.mark(&wanted.path, &reason).is_err() {
                outcome = Outcome::Failed;
            }
            let _the_tally_is_there = self.reports.send(report.ended(outcome, &reason));
            if inputs.tracks && outcome == Outcome::Failed {
                self.tracking = Tracking::Failed(wanted.drive);
                self.io.left_alone.store(wanted.drive, Ordering::Relaxed);
                return;
            }
            if inputs.tracks {
                let tracks = self.tracks_of(wanted.drive);
                self.tracking = tracks.map_or(Tracking::NotBegun, Tracking::Ended);
            }
        }
        if inputs.tracks
            && wanted.pair + 1 == drive.pairs()
            && let Some(tracks) = self.tracks_of(wanted.drive)
        {
            let _the_writer_is_there = self.outputs.send(*tracks);
        }
    }

    fn estimate(
        &mut self,
        wanted: &Wanted,
        solver: &mut dyn Solver,
        control: &dyn Control,
        report: &mut RowReport,
    ) -> Result<(), (Outcome, String)> {
        let inputs = self.io.inputs;
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
            // A label does not depend on whether a store failed for a while.
            if unread.may_pass || index == wanted.pair || index == wanted.pair + 1 {
                let outcome = Outcome::of_trouble(unread.may_pass);
                return Err((outcome, unread.reason.clone()));
            }
            report.left_out.push(unread.reason.clone());
        }
        let is_current = self.is_current(wanted, &report.left_out);
        if is_current && !inputs.tracks {
            return Ok(());
        }
        let mask = self.mask(wanted)?;
        let pair = [wanted.pair, wanted.pair + 1];
        let [source, target] = pair.map(|index| loaded(index).expect("both sweeps were read"));
        let refused = [source, target].map(|loaded| loaded.refused_times.clone());
        report.warnings.extend(refused.into_iter().flatten());
        let apart_s = self.interval_s(wanted, [source.clock, target.clock]);
        let mut options = inputs.options.clone();
        options.dt_s = options.dt_s.or(apart_s.map(f32::abs));
        let larger = source.points.len().max(target.points.len());
        let mut solver_options = options.solver_options(larger);
        solver_options.newest_first = apart_s.is_some_and(f32::is_sign_negative);
        let pose = |index: usize| drive.sweeps[index].pose.unwrap_or_default();
        let poses = inputs.poses.then(|| pair.map(pose));
        solver_options.ego = solver_options.ego.of_pair(poses, false);
        let windowed = WindowedPair {
            pair: wanted.pair,
            count,
            sweeps: size,
            before: None,
        };
        let sweep = |index: usize| Some(&loaded(index)?.sweep);
        let neighbors = window(wanted.pair, count, size).filter(|index| !pair.contains(index));
        let neighbors = neighbors.filter_map(|index| Some(loaded(index)?.points.len()));
        let clouds = [&source.sweep, &target.sweep];
        self.check_memory(clouds, neighbors, &solver_options)?;
        let solve =
            || solver.solve(&|backend| windowed.estimate(backend, sweep, &solver_options, control));
        let solved = isolated("its estimate", solve).map_err(|text| (Outcome::Refused, text))?;
        let mut estimate = solved.map_err(|error| failed(&error))?;
        let [source, target] = estimate.sweeps([&source.points, &target.points]);
        if inputs.tracks {
            if matches!(self.tracking, Tracking::NotBegun) {
                self.tracking = Tracking::Begun(Box::default());
            }
            if let Tracking::Begun(tracker) = &mut self.tracking {
                let dt_s = solver_options.dt_s;
                let tracked = push_and_correct(tracker, [&source, &target], &mut estimate, dt_s);
                tracked.map_err(|error| (Outcome::Refused, error.to_string()))?;
            }
        }
        // Flows after one that has changed, and those of a drive that was interrupted, may have the
        // motions of other tracks.
        let is_retracked = !wanted.has_tracks || self.changed == Some(wanted.drive);
        if is_current && !is_retracked {
            return Ok(());
        }
        self.put(wanted, &source, &estimate, mask.as_deref(), report.clone());
        Ok(())
    }

    /// Whether an output is there that would not change: it lacks no sweep, or the same ones as now.
    fn is_current(&self, wanted: &Wanted, left_out: &[String]) -> bool {
        if !wanted.is_there || !wanted.is_marked {
            return wanted.is_there;
        }
        let path = left_out_path(&wanted.path);
        let read = || self.io.runtime.block_on(self.io.inputs.output.read(&path));
        let mark = self.io.patiently(read);
        !left_out.is_empty() && mark.is_ok_and(|mark| mark == mark_text(left_out).as_bytes())
    }

    /// Refuses a pair that needs more memory than a run may take. `neighbors` are the numbers of points
    /// of the sweeps around it.
    fn check_memory(
        &self,
        [source, target]: [&Sweep; 2],
        neighbors: impl Iterator<Item = usize>,
        options: &Options,
    ) -> Result<(), (Outcome, String)> {
        let most = self.io.inputs.most_bytes;
        let neighbors: usize = neighbors.map(|points| neighbor_cost(points).bytes).sum();
        let points = source.points.len() + target.points.len();
        // The prediction takes longer, and is left out where this bound suffices.
        let bound = MIN_BYTES + points * OBJECT_BYTES + neighbors;
        if matches!(options.method, Method::Objects(_)) && bound <= most {
            return Ok(());
        }
        let ground = source.ground.as_deref().zip(target.ground.as_deref());
        let problem = Problem {
            ground: ground.map(<[_; 2]>::from),
            ..Problem::pair(&source.points, &target.points)
        };
        let cost = predict_cost(&problem, options).map_err(|error| failed(&error))?;
        match (cost.bytes + neighbors).checked_sub(most) {
            Some(1..) => Err((
                Outcome::Refused,
                format!(
                    "it needs {} MiB of memory, and --max-memory-mib allows {}: crop with --crop-m",
                    (cost.bytes + neighbors) >> 20,
                    most >> 20
                ),
            )),
            _ => Ok(()),
        }
    }

    /// Takes the sweeps of a window, and drops those that no later pair needs.
    fn gather(&mut self, wanted: &Wanted, count: usize, size: usize) {
        let range = window(wanted.pair, count, size);
        let first = (wanted.drive, range.start);
        self.held = self.held.split_off(&first);
        let last = (wanted.drive, range.end - 1);
        while !self.held.contains_key(&last) {
            let Ok((at, loaded)) = self.read.recv() else {
                break;
            };
            // Of a drive that has failed.
            if at < first {
                continue;
            }
            let prepared = loaded.and_then(|loaded| self.prepared(at, loaded));
            self.held.insert(at, prepared);
        }
    }

    /// A sweep with its ground, see [`Sweep::prepared`].
    fn prepared(&self, (drive, sweep): At, loaded: Loaded) -> Result<Loaded, Unread> {
        let uri = &self.io.inputs.plan.drives()[drive].sweeps[sweep].uri;
        let options = self.io.inputs.options.solver_options(usize::MAX);
        let sweep = isolated("its ground segmentation", || {
            loaded.sweep.prepared(&options)
        });
        let sweep = sweep.map_err(|reason| Unread {
            reason: format!("{uri}: {reason}"),
            may_pass: false,
        })?;
        Ok(Loaded { sweep, ..loaded })
    }

    /// The rows that the layout asks for.
    fn mask(&self, wanted: &Wanted) -> Result<Option<Vec<bool>>, (Outcome, String)> {
        let Some(masks) = &self.io.inputs.masks else {
            return Ok(None);
        };
        let read = || self.io.runtime.block_on(masks.read(&wanted.path));
        let bytes = self.io.patiently(read).map_err(|error| {
            let outcome = Outcome::of_trouble(error.may_pass());
            (outcome, format!("its mask: {error}"))
        })?;
        let mask = read_av2_mask(&bytes);
        mask.map(Some)
            .map_err(|error| (Outcome::Refused, format!("its mask: {error}")))
    }

    /// Seconds from the source of a pair to its target; below zero where the target was measured
    /// first. None where no time is known.
    fn interval_s(&self, wanted: &Wanted, clocks: [Option<SweepClock>; 2]) -> Option<f32> {
        let sweeps = &self.io.inputs.plan.drives()[wanted.drive].sweeps[wanted.pair..];
        let times = sweeps[0].time_s.zip(sweeps[1].time_s);
        let apart = times.map(|(source, target)| target - source);
        let names = [&sweeps[0].uri, &sweeps[1].uri].map(|uri| path_of(uri));
        apart
            .filter(|apart| is_interval(apart.abs()))
            .map(|apart| apart as f32)
            .or_else(|| pair_interval_s(names.each_ref().map(String::as_str), clocks))
    }

    fn put(
        &mut self,
        wanted: &Wanted,
        source: &[Point],
        estimate: &Estimate,
        mask: Option<&[bool]>,
        report: RowReport,
    ) {
        let drive = &self.io.inputs.plan.drives()[wanted.drive];
        let bytes = self.io.inputs.layout.bytes(source, estimate, mask);
        let is_first = bytes.is_ok() && self.changed.replace(wanted.drive) != Some(wanted.drive);
        let output = Output {
            drive: wanted.drive,
            path: wanted.path.clone(),
            replaces: wanted.is_there,
            removes: (is_first && wanted.has_tracks).then(|| tracks_path(&drive.name)),
            is_marked: wanted.is_marked,
            bytes,
            report: report.with(estimate),
        };
        let _the_writer_is_there = self.outputs.send(output);
    }

    /// The tracks of a drive, and begins anew; none where a pair of the drive has failed. They replace
    /// those of an earlier run, which could not label a pair.
    fn tracks_of(&mut self, drive: usize) -> Option<Box<Output>> {
        let tracker = match std::mem::take(&mut self.tracking) {
            Tracking::NotBegun => Tracker::default(),
            Tracking::Begun(tracker) => *tracker,
            Tracking::Ended(tracks) => return Some(tracks),
            Tracking::Failed(_) => return None,
        };
        let name = &self.io.inputs.plan.drives()[drive].name;
        let mut bytes = Vec::new();
        let written = write_tracks(&tracker.finish(), &mut bytes);
        let path = tracks_path(name);
        Some(Box::new(Output {
            report: RowReport {
                tracks: true,
                ..RowReport::new(path.clone(), name, name)
            },
            drive,
            path,
            replaces: true,
            removes: None,
            is_marked: false,
            bytes: written.map(|()| bytes),
        }))
    }
}

/// What became of a pair whose estimate failed.
fn failed(error: &FlowError) -> (Outcome, String) {
    (Outcome::of_trouble(!error.is_input()), error.to_string())
}
