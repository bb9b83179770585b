//! The pairs of a sequence: takes sweeps one by one, and writes each flow as soon as it is complete.

use std::collections::VecDeque;
use std::fmt;
use std::path::Path;
use std::sync::Arc;

use anyhow::anyhow;

use super::arguments::{DeskewChoice, Flow};
use super::output::{Arrival, Complete, put};
use crate::cli::estimation::{Device, Surroundings};
use crate::cli::failure::Failure;
use crate::cli::machine::peak_resident_bytes;
use crate::cli::output::complain;
use crate::cli::terminal::Terminal;
use crate::cli::tracks::Tracking;
use crate::flow::{Control, Estimate, Interrupt, Point, Progress, Sequence, Sweep};
use crate::job::{JobOptions, Report};

/// What is known of a sweep besides its points.
#[derive(Clone, Debug, Default)]
pub(super) struct Taken {
    /// Seconds spent on reading the sweep.
    pub(super) load: f64,
    /// Its name; empty for a sweep of a pair in one file.
    pub(super) name: String,
    /// When it was written, in a folder that is followed.
    pub(super) arrived: Option<Arrival>,
}

/// A pair whose estimate is not complete, because its window may need later sweeps.
struct Waiting {
    pair: usize,
    points: [Arc<[Point]>; 2],
    names: [String; 2],
    target: Taken,
    /// The target as it was read, should the sequence start again with it.
    sweep: Arc<Sweep>,
}

/// The pairs of a sequence that is read sweep by sweep.
pub(super) struct Pairs<'a> {
    flow: &'a Flow,
    options: JobOptions,
    pub(super) surroundings: Surroundings,
    tracking: Option<Tracking<'a>>,
    device: Device<'a>,
    pub(super) terminal: Terminal,
    sequence: Sequence,
    /// The pairs that are not complete, and the last sweep with its name.
    waiting: VecDeque<Waiting>,
    last: Option<(Arc<[Point]>, String)>,
    /// Number of sweeps so far.
    sweeps: usize,
    /// Number of pairs in all.
    count: usize,
    /// Seconds that the last flow took to be written, which the next one is due earlier by.
    writing_s: f64,
    /// Latencies of the written flows that were not asked for yet, seconds.
    latencies_s: Vec<f64>,
}

impl<'a> Pairs<'a> {
    /// For `count` pairs.
    pub(super) fn new(
        flow: &'a Flow,
        options: JobOptions,
        surroundings: Surroundings,
        tracking: Option<Tracking<'a>>,
        count: usize,
    ) -> Result<Self, Failure> {
        Ok(Self {
            device: flow.estimation.open()?,
            flow,
            options,
            surroundings,
            tracking,
            terminal: Terminal::new(),
            sequence: Sequence::default(),
            waiting: VecDeque::new(),
            last: None,
            sweeps: 0,
            count,
            writing_s: 0.0,
            latencies_s: Vec::new(),
        })
    }

    /// Reads the next sweep, with the times of its points unless they are not asked for.
    pub(super) fn read(&mut self, path: &Path) -> Result<(Sweep, Taken), Failure> {
        let began = self.terminal.seconds();
        let mut sweep = self.surroundings.sweep(self.sweeps, path)?;
        if self.flow.deskew == DeskewChoice::Off {
            sweep.times = None;
        }
        if self.flow.deskew == DeskewChoice::On && sweep.times.is_none() {
            let path = path.display();
            return Err(Failure::bad_input(anyhow!(
                "{path}: its points have no times, which --deskew on needs"
            )));
        }
        let name = path.file_name().unwrap_or_default();
        let taken = Taken {
            load: self.terminal.seconds() - began,
            name: name.to_string_lossy().into_owned(),
            arrived: None,
        };
        Ok((sweep, taken))
    }

    /// Adds the next sweep, and writes the flows that are complete with it.
    pub(super) fn push(&mut self, sweep: &Arc<Sweep>, taken: Taken) -> Result<(), Failure> {
        let index = self.sweeps;
        self.sweeps += 1;
        let points: Arc<[Point]> = sweep.points.as_slice().into();
        let last = self.last.replace((Arc::clone(&points), taken.name.clone()));
        let larger = points
            .len()
            .max(last.as_ref().map_or(0, |(last, _)| last.len()));
        let pair = [index.saturating_sub(1), index];
        let mut options = self.surroundings.options(&self.options, larger, pair);
        options.always_deskew = self.flow.deskew == DeskewChoice::On;
        let due = Due {
            terminal: &self.terminal,
            due_s: taken
                .arrived
                .and_then(|arrived| Some(arrived.due_s? - self.writing_s)),
        };
        if let Some((source, name)) = last {
            self.waiting.push_back(Waiting {
                pair: pair[0],
                names: [name, taken.name.clone()],
                points: [source, points],
                target: taken,
                sweep: Arc::clone(sweep),
            });
        }
        let found = self
            .device
            .push(&mut self.sequence, sweep, &options, &due)?;
        // Complete pairs are written before the next one is estimated, which may fail.
        self.write(found)
    }

    /// Adds the next sweep, and goes on after a pair that is refused.
    pub(super) fn push_or_warn(&mut self, sweep: &Arc<Sweep>, taken: Taken) -> Result<(), Failure> {
        let pushed = self.push(sweep, taken);
        self.go_on(pushed)
    }

    /// Writes the flows that wait for sweeps that do not come, and goes on after a pair that is refused.
    pub(super) fn flush_or_warn(&mut self) -> Result<(), Failure> {
        loop {
            match self.flush() {
                Err(failure) if failure.is_of_input() => self.go_on(Err(failure))?,
                flushed => return flushed,
            }
        }
    }

    /// Warns of a pair that was refused. The sequence starts again with the first sweep after the pair.
    fn go_on(&mut self, mut done: Result<(), Failure>) -> Result<(), Failure> {
        let mut later: VecDeque<(Arc<Sweep>, Taken)> = VecDeque::new();
        loop {
            if let Err(failure) = &done
                && failure.is_of_input()
                && let Some(refused) = self.waiting.pop_front()
            {
                let [source, target] = &refused.names;
                warn(&format_args!("{source} to {target}: {failure}"));
                let waiting = core::mem::take(&mut self.waiting).into_iter();
                let mut waiting: VecDeque<_> = waiting.map(|one| (one.sweep, one.target)).collect();
                waiting.append(&mut later);
                later = waiting;
                self.restart_at(refused.pair + 2);
                done = Ok(());
            }
            match later.pop_front() {
                Some((sweep, taken)) if done.is_ok() => done = self.push(&sweep, taken),
                _ => return done,
            }
        }
    }

    /// Writes the flows that wait for sweeps that do not come.
    pub(super) fn flush(&mut self) -> Result<(), Failure> {
        loop {
            let found = self.device.finish(&mut self.sequence, &self.terminal)?;
            if found.is_empty() {
                return Ok(());
            }
            self.write(found)?;
        }
    }

    /// Ends the sequence. `done` says how its pairs ended so far. The tracks before a pair that is refused
    /// are written.
    pub(super) fn finish(mut self, done: Result<(), Failure>) -> Result<(), Failure> {
        let done = done.and_then(|()| self.flush());
        let tracking = self.tracking.filter(Tracking::has_pairs);
        match (&done, tracking) {
            (Err(failure), _) if !failure.is_of_input() => done,
            (_, Some(tracking)) => done.and(tracking.finish(self.flow.json)),
            (_, None) => done,
        }
    }

    /// Begins a new sequence with the next sweep.
    pub(super) fn restart(&mut self) {
        self.restart_at(self.surroundings.end());
    }

    /// Begins a new sequence with the sweep of index `index`.
    fn restart_at(&mut self, index: usize) {
        self.sequence = Sequence::default();
        self.waiting.clear();
        self.last = None;
        self.sweeps = index;
    }

    /// Seconds from the last byte of a sweep to its flow, of the flows since the last call.
    pub(super) fn take_latencies(&mut self) -> Vec<f64> {
        core::mem::take(&mut self.latencies_s)
    }

    fn write(&mut self, mut found: Vec<Estimate>) -> Result<(), Failure> {
        self.terminal.finish();
        for estimate in &mut found {
            let began = self.terminal.seconds();
            let Some(waiting) = self.waiting.pop_front() else {
                break;
            };
            let pair = [waiting.pair, waiting.pair + 1];
            let options = self.surroundings.timed(&self.options, pair);
            self.surroundings.forget_before(waiting.pair);
            let [source, target] = &waiting.points;
            let [source, target] = estimate.sweeps([source, target]);
            if let Some(tracking) = &mut self.tracking {
                let dt_s = options.solver_options(0).dt_s;
                tracking.push([&source, &target], estimate, dt_s)?;
            }
            let mut report = Report::new(estimate, &options);
            report.seconds.load = Some(waiting.target.load);
            report.seconds.total += waiting.target.load;
            report.peak_rss_bytes = peak_resident_bytes();
            let complete = Complete {
                estimate,
                report,
                source: &source,
                number: [waiting.pair, self.count],
                names: &waiting.names,
                arrived: waiting.target.arrived,
            };
            match put(self.flow, &complete) {
                Ok(latency_s) => self.latencies_s.extend(latency_s),
                Err(failure) => {
                    self.waiting.push_front(waiting);
                    return Err(failure);
                }
            }
            self.writing_s = self.terminal.seconds() - began;
        }
        Ok(())
    }
}

/// The terminal with the time at which a flow is due.
struct Due<'a> {
    terminal: &'a Terminal,
    due_s: Option<f64>,
}

impl Control for Due<'_> {
    fn seconds(&self) -> f64 {
        self.terminal.seconds()
    }

    fn seconds_left(&self) -> Option<f64> {
        self.due_s.map(|due_s| due_s - self.terminal.seconds())
    }

    fn interrupt(&self) -> Option<Interrupt> {
        let late = self.seconds_left().is_some_and(|left| left <= 0.0);
        late.then_some(Interrupt::Deadline)
    }

    fn progress(&self, progress: Progress) {
        self.terminal.progress(progress);
    }
}

/// Warns of a sweep or a pair that cannot be used.
pub(super) fn warn(failure: &dyn fmt::Display) {
    complain(format_args!(
        "warning: {failure}; the sequence starts again after it"
    ));
}
