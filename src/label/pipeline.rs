//! The pipeline of a shard: sweeps are read ahead and outputs are written behind, while a pair is
//! estimated.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{SyncSender, channel, sync_channel};
use std::thread;

use super::error::LabelError;
use super::estimates::{Estimates, Tracking};
use super::io::{At, Io, Loaded, Output, Unread, Wanted};
use super::places::Places;
use super::report::Outcome;
use super::tally::Tally;
use super::types::{Done, Solver, Told};
use crate::flow::{Control, window};

/// Sweeps that are read ahead.
const AHEAD: usize = 6;
/// Outputs that wait to be written.
const BEHIND: usize = 4;

/// Labels the pairs `wanted`, of `total` pairs of the shard.
pub(super) fn label(
    io: &Io<'_>,
    wanted: &[Wanted],
    total: usize,
    solver: &mut dyn Solver,
    control: &dyn Control,
    told: &mut dyn FnMut(&Told),
) -> Result<Done, LabelError> {
    let (sweeps, read) = sync_channel(AHEAD);
    let (outputs, to_write) = sync_channel::<Output>(BEHIND);
    let (reports, reported) = channel();
    thread::scope(|scope| {
        scope.spawn(move || read_ahead(io, wanted, &sweeps));
        let written = reports.clone();
        scope.spawn(move || {
            let mut failed = None;
            while let Ok(output) = to_write.recv() {
                let drive = output.drive;
                // Tracks say that all outputs before them are there: the next run begins the drive again.
                let report = if io.inputs.tracks && failed == Some(drive) {
                    let reason = "another output of its drive was not written";
                    output.report.ended(Outcome::Failed, &reason)
                } else {
                    io.write(output)
                };
                if report.outcome == Outcome::Failed {
                    failed = Some(drive);
                }
                let _the_tally_is_there = written.send(report);
            }
        });
        let mut estimates = Estimates {
            io,
            read,
            held: BTreeMap::new(),
            outputs,
            reports,
            tracking: Tracking::NotBegun,
            changed: None,
        };
        let mut tally = Tally::new(io, wanted, total, &reported);
        for wanted in wanted {
            if io.stop.load(Ordering::Relaxed) {
                tally.done.stopped = true;
                break;
            }
            estimates.label(wanted, solver, control);
            tally.take(told);
        }
        // This closes both channels. The reader and the writer end with theirs.
        drop(estimates);
        tally.finish(told)
    })
}

/// Reads the sweeps of all windows, each once, in the order in which they are needed.
fn read_ahead(io: &Io<'_>, wanted: &[Wanted], sweeps: &SyncSender<(At, Result<Loaded, Unread>)>) {
    let places = Places::default();
    let size = io.inputs.options.solver_options(0).sweeps();
    let mut next: HashMap<usize, (usize, bool)> = HashMap::new();
    for wanted in wanted {
        let drive = &io.inputs.plan.drives()[wanted.drive];
        // Clocks are not mixed.
        let of_drive = || (0, drive.sweeps.iter().all(|sweep| sweep.time_s.is_some()));
        let (next, is_timed) = next.entry(wanted.drive).or_insert_with(of_drive);
        let is_timed = *is_timed;
        for index in window(wanted.pair, drive.sweeps.len(), size) {
            if index < *next || io.left_alone.load(Ordering::Relaxed) == wanted.drive {
                continue;
            }
            *next = index + 1;
            let sweep = &drive.sweeps[index];
            let time_s = sweep.time_s.filter(|_| is_timed);
            let loaded = io.read(&places, &sweep.uri, time_s);
            if sweeps.send(((wanted.drive, index), loaded)).is_err() {
                return;
            }
        }
    }
}
