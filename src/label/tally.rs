//! The count of what became of the pairs of a shard, and its report.

use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use bytes::Bytes;

use super::error::LabelError;
use super::io::{Io, Wanted};
use super::places::PlaceError;
use super::report::{Outcome, RowReport, lines};
use super::types::{Done, Told};

/// How often the report is written.
const REPORT_EVERY: Duration = Duration::from_secs(30);
/// Rows of a part of the report, and troubles that are kept.
const PART: usize = 1000;

/// Counts the reports, and writes them from time to time.
pub(super) struct Tally<'a> {
    io: &'a Io<'a>,
    reported: &'a Receiver<RowReport>,
    reports: Vec<RowReport>,
    pub(super) done: Done,
    began: Instant,
    written: Instant,
    /// Whether the store has refused the part that is being filled.
    has_failed: bool,
    /// The name of the report without its number and ending.
    name: String,
    /// Number of the part that is being filled.
    part: usize,
}

impl<'a> Tally<'a> {
    pub(super) fn new(
        io: &'a Io<'a>,
        wanted: &[Wanted],
        total: usize,
        reported: &'a Receiver<RowReport>,
    ) -> Self {
        let shard = io.inputs.shard;
        let attempt = uuid::Uuid::now_v7();
        let waiting = wanted.iter().filter(|wanted| !wanted.is_there).count();
        Self {
            io,
            reported,
            reports: Vec::new(),
            done: Done {
                pairs: total,
                found: total - waiting,
                ..Done::default()
            },
            began: Instant::now(),
            written: Instant::now(),
            has_failed: false,
            name: format!("_report/{attempt}-{}-of-{}", shard.index, shard.count),
            part: 0,
        }
    }

    /// Takes the reports that are there.
    pub(super) fn take(&mut self, told: &mut dyn FnMut(&Told)) {
        let mut is_new = false;
        while let Ok(report) = self.reported.try_recv() {
            self.count(report);
            is_new = true;
        }
        if is_new {
            told(&self.told());
        }
        let is_full = self.reports.len() >= PART;
        // A part that the store does not take is written again with the next reports, and not at once: each
        // attempt has patience.
        if self.written.elapsed() > REPORT_EVERY || (is_full && !self.has_failed) {
            self.has_failed = self.write().is_err();
            self.written = Instant::now();
            if is_full && !self.has_failed {
                self.part += 1;
                self.reports.clear();
            }
        }
    }

    fn count(&mut self, report: RowReport) {
        let is_pair = !report.tracks;
        self.done.found -= usize::from(report.was_there);
        match report.outcome {
            Outcome::Labelled => self.done.labelled += usize::from(is_pair),
            Outcome::Raced => self.done.raced += usize::from(is_pair),
            Outcome::Refused => self.done.refused += 1,
            Outcome::Failed => self.done.failed += 1,
        }
        if !report.is_there() && self.done.troubles.len() < PART {
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
        let path = format!("{}-{}.jsonl", self.name, self.part);
        let (runtime, output) = (self.io.runtime, &self.io.inputs.output);
        let put = || runtime.block_on(output.put(&path, bytes.clone()));
        self.io.patiently(put)
    }

    /// Waits for the outputs that are being written, and writes the last report.
    pub(super) fn finish(mut self, told: &mut dyn FnMut(&Told)) -> Result<Done, LabelError> {
        while let Ok(report) = self.reported.recv() {
            self.count(report);
            told(&self.told());
        }
        self.write()?;
        Ok(self.done)
    }
}
