//! `fnsf flow --follow`: the sweeps of a folder in the order in which they are written.

use std::collections::{HashMap, VecDeque};
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, anyhow};
use clap::Args;
use notify::event::{AccessKind, AccessMode, CreateKind, EventKind, ModifyKind, RenameMode};
use notify::{Event, RecursiveMode, Watcher};

use crate::cli::estimation::Estimation;
use crate::cli::failure::Failure;
use crate::cli::output::complain;
use crate::cli::tracks::TrackArguments;
use crate::formats::compare_names;

/// Time between two warnings that flows take too long.
const BETWEEN_WARNINGS: Duration = Duration::from_secs(10);
/// Number of waiting sweeps from which flows take too long.
const BEHIND: usize = 2;
/// Time without a change after which a file that was there before is complete. Nothing tells when it was closed.
const SETTLED: Duration = Duration::from_secs(1);

/// Options of a folder that is followed.
#[derive(Clone, Debug, Args)]
pub(super) struct FollowArguments {
    /// Folder whose sweeps are taken as they are written, first those that are there. A sweep is
    /// taken when its file is closed (on Linux) or moved into the folder under its name, one that is
    /// there when it has not changed for a second. Names that begin with a dot or end in .tmp or
    /// .part are left alone. Ends by Ctrl-C, or by --idle-s
    #[arg(
        long,
        value_name = "DIR",
        conflicts_with = "sweeps",
        requires = "output"
    )]
    pub(super) follow: Option<PathBuf>,
    /// Seconds without a new sweep after which a folder is no longer followed
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    idle_s: Option<Duration>,
    /// Milliseconds from the last byte of a sweep until its flow is due. The best flow that is found
    /// until then is written, so that a slow machine keeps up
    #[arg(long, value_name = "MS", value_parser = clap::value_parser!(u32).range(1..))]
    due_ms: Option<u32>,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| *seconds > 0.0);
    let seconds = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    seconds.ok_or_else(|| "a positive number of seconds is needed".to_owned())
}

impl FollowArguments {
    /// Refuses options that need all sweeps with a folder, and options of a folder without one.
    pub(super) fn check(
        &self,
        tracks: &TrackArguments,
        estimation: &Estimation,
    ) -> Result<(), Failure> {
        let refused = if self.follow.is_none() {
            if self.idle_s.is_none() && self.due_ms.is_none() {
                return Ok(());
            }
            "--idle-s and --due-ms are for --follow DIR"
        } else if tracks.outputs().next().is_some() {
            "tracks are written at the end of a sequence, which --follow does not have"
        } else if !estimation.files().is_empty() {
            "--poses, --ego FILE and --ground-raster are for sweeps that are known before: they do \
             not go with --follow"
        } else {
            return Ok(());
        };
        Err(Failure::usage(anyhow!(refused)))
    }

    /// When the flow of a sweep is due, seconds of a clock that shows `now_s`.
    pub(super) fn due_s(&self, arrived: &Arrived, now_s: f64) -> Option<f64> {
        let age = arrived.written.elapsed().unwrap_or_default();
        let due_ms = f64::from(self.due_ms?);
        Some(now_s + due_ms / 1e3 - age.as_secs_f64())
    }
}

/// A sweep that was written.
pub(super) struct Arrived {
    pub(super) path: PathBuf,
    /// When its last byte was written.
    pub(super) written: SystemTime,
}

/// The size of a file, and when it was last written.
type Version = (u64, SystemTime);

/// The sweeps of a folder.
pub(super) struct Arrivals {
    events: Receiver<notify::Result<Event>>,
    /// Reports the events as long as it lives.
    _watcher: Box<dyn Watcher>,
    waiting: VecDeque<PathBuf>,
    /// The sweeps that were there before, each as it was when it was taken. Late events of what was taken are
    /// left alone.
    present: HashMap<PathBuf, Option<Version>>,
    /// The sweep that was taken last, as it was then: a writer may close it twice.
    last: Option<(PathBuf, Option<Version>)>,
    idle: Option<Duration>,
    can_be_due: bool,
    warned: Option<Instant>,
}

impl Arrivals {
    /// Begins to watch a folder.
    pub(super) fn watch(folder: &Path, arguments: &FollowArguments) -> Result<Self, Failure> {
        let named = || folder.display().to_string();
        // The paths of events are absolute.
        let folder = &std::path::absolute(folder)
            .with_context(named)
            .map_err(Failure::bad_input)?;
        let (sender, events) = channel();
        let watched = notify::recommended_watcher(sender).and_then(|mut watcher| {
            watcher.watch(folder, RecursiveMode::NonRecursive)?;
            Ok(watcher)
        });
        let watcher = watched.with_context(named).map_err(Failure::bad_input)?;
        let entries = std::fs::read_dir(folder).with_context(named);
        let entries = entries.map_err(Failure::bad_input)?;
        let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
        let mut paths: Vec<PathBuf> = paths
            .filter(|path| is_sweep(path) && path.is_file())
            .collect();
        let name = |path: &PathBuf| path.to_string_lossy().into_owned();
        paths.sort_by(|a, b| compare_names(&name(a), &name(b)));
        Ok(Self {
            events,
            _watcher: Box::new(watcher),
            present: paths.iter().cloned().map(|path| (path, None)).collect(),
            waiting: paths.into(),
            last: None,
            idle: arguments.idle_s,
            can_be_due: arguments.due_ms.is_some(),
            warned: None,
        })
    }

    /// Number of sweeps that are written and not taken.
    pub(super) fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Takes the next sweep; waits until there is one. None after a time without a new one.
    pub(super) fn next(&mut self) -> Result<Option<Arrived>, Failure> {
        let mut asked = Instant::now();
        loop {
            while let Ok(event) = self.events.try_recv() {
                self.add(event)?;
            }
            let settles = self.waiting.front().and_then(|path| self.settles_in(path));
            if settles.is_none()
                && let Some(path) = self.waiting.pop_front()
            {
                self.warn();
                let version = version(&path);
                if let Some(taken) = self.present.get_mut(&path) {
                    *taken = version;
                }
                self.last = Some((path.clone(), version));
                // A sweep that is gone is refused when it is read.
                let written = version.map_or_else(SystemTime::now, |(_, written)| written);
                return Ok(Some(Arrived { path, written }));
            }
            let left = match (settles, self.idle) {
                (Some(left), _) => left,
                (None, None) => Duration::MAX,
                (None, Some(idle)) => idle.saturating_sub(asked.elapsed()),
            };
            match self
                .events
                .recv_timeout(left.min(Duration::from_secs(3600)))
            {
                Ok(event) => self.add(event)?,
                Err(RecvTimeoutError::Timeout) if settles.is_some() => {}
                Err(RecvTimeoutError::Timeout)
                    if self.idle.is_some_and(|idle| asked.elapsed() >= idle) =>
                {
                    return Ok(None);
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(Failure::internal(anyhow!(
                        "the folder is no longer watched"
                    )));
                }
            }
            if !self.waiting.is_empty() {
                asked = Instant::now();
            }
        }
    }

    /// Adds the sweeps that an event completes.
    fn add(&mut self, event: notify::Result<Event>) -> Result<(), Failure> {
        let event = event.map_err(Failure::internal)?;
        if event.need_rescan() {
            complain(format_args!(
                "warning: the system lost events of the folder, so that sweeps may be missing"
            ));
        }
        if !completes(event.kind) {
            return Ok(());
        }
        let Some(path) = event.paths.into_iter().next() else {
            return Ok(());
        };
        // Reading a pipe may never end.
        if !is_sweep(&path) || !path.is_file() {
            return Ok(());
        }
        match self.present.get(&path) {
            // It waits, and is complete.
            Some(None) => drop(self.present.remove(&path)),
            Some(taken) if *taken == version(&path) => {}
            _ if self.waiting.contains(&path) => {}
            None if self.last == Some((path.clone(), version(&path))) => {}
            _ => self.waiting.push_back(path),
        }
        Ok(())
    }

    /// The time after which a sweep that was there before is complete, if nothing more is written. None if it
    /// is complete.
    fn settles_in(&self, path: &Path) -> Option<Duration> {
        let (_, written) = match self.present.get(path)? {
            None => version(path)?,
            Some(_) => return None,
        };
        let left = SETTLED.checked_sub(written.elapsed().ok()?)?;
        (!left.is_zero()).then_some(left)
    }

    /// Says that flows take longer than the time between the sweeps that come.
    fn warn(&mut self) {
        let came = |path: &&PathBuf| !self.present.contains_key(*path);
        let count = self.waiting.iter().filter(came).count();
        let is_due = self
            .warned
            .is_none_or(|at| at.elapsed() >= BETWEEN_WARNINGS);
        if count < BEHIND || !is_due {
            return;
        }
        self.warned = Some(Instant::now());
        let advice = match self.can_be_due {
            true => "a smaller --due-ms leaves less for each",
            false => "--due-ms gives each flow a time",
        };
        complain(format_args!(
            "warning: {count} sweeps wait, because flows take longer than the time between \
             sweeps: {advice}"
        ));
    }
}

/// The version of a file. None if it is gone.
fn version(path: &Path) -> Option<Version> {
    let file = path.metadata().ok()?;
    Some((file.len(), file.modified().ok()?))
}

/// Whether a file is complete after an event of this kind.
fn completes(kind: EventKind) -> bool {
    match kind {
        EventKind::Access(AccessKind::Close(AccessMode::Write)) => true,
        // A rename within the folder is also told as one event of both names.
        EventKind::Modify(ModifyKind::Name(mode)) => {
            matches!(mode, RenameMode::To | RenameMode::Any)
        }
        // Where the system does not say that a file was closed, one that is moved is new.
        EventKind::Create(CreateKind::File) => !cfg!(target_os = "linux"),
        _ => false,
    }
}

/// Whether a file's name is that of a sweep and not of a file that is being written.
fn is_sweep(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let unfinished = [".tmp", ".part"]
        .iter()
        .any(|ending| name.ends_with(ending));
    !name.is_empty() && !name.starts_with('.') && !unfinished
}

/// Counts of latencies by milliseconds.
#[derive(Default)]
pub(super) struct Latencies {
    /// Number of latencies of each millisecond, the last for all longer ones.
    counts: Vec<u64>,
    longest_s: f64,
}

impl Latencies {
    /// Bins of one millisecond.
    const BINS: usize = 60_000;

    /// Adds latencies in seconds.
    pub(super) fn add(&mut self, latencies_s: &[f64]) {
        self.counts.resize(Self::BINS, 0);
        for &latency_s in latencies_s {
            let bin = (latency_s * 1e3) as usize;
            self.counts[bin.min(Self::BINS - 1)] += 1;
            self.longest_s = self.longest_s.max(latency_s);
        }
    }

    /// The upper end of the bin of a quantile, milliseconds.
    fn quantile_ms(&self, share: f64) -> usize {
        let total: u64 = self.counts.iter().sum();
        let wanted = (share * total as f64).ceil() as u64;
        let mut sum = 0;
        let reaches = |&count: &u64| {
            sum += count;
            sum >= wanted
        };
        self.counts
            .iter()
            .position(reaches)
            .map_or(0, |bin| bin + 1)
    }
}

impl fmt::Display for Latencies {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let total: u64 = self.counts.iter().sum();
        if total == 0 {
            return f.write_str("no flow was written");
        }
        let [median, most] = [0.5, 0.99].map(|share| self.quantile_ms(share));
        write!(
            f,
            "{total} flows, each after its sweep by {median} ms (median), {most} ms (99%), {:.0} ms (most)",
            (self.longest_s * 1e3).ceil()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_the_ends_of_their_milliseconds() {
        let mut latencies = Latencies::default();
        assert_eq!(latencies.to_string(), "no flow was written");
        let all: Vec<f64> = (0..100).map(|ms| f64::from(ms) / 1e3 + 5e-4).collect();
        latencies.add(&all);
        latencies.add(&[700.0]);
        assert_eq!(
            latencies.to_string(),
            "101 flows, each after its sweep by 51 ms (median), 100 ms (99%), 700000 ms (most)"
        );
    }

    #[test]
    fn files_that_are_being_written_are_no_sweeps() {
        let is = |name: &str| is_sweep(&Path::new("/sweeps").join(name));
        assert!(is("000001.pcd") && is("a.feather"));
        assert!(!is(".000001.pcd") && !is("000001.pcd.tmp") && !is("1.bin.part"));
    }
}
