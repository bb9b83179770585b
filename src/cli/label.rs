//! `fnsf label`: the flows of many drives, by any number of processes.

use std::path::Path;
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use clap::Args;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use tokio::signal::unix::{SignalKind, signal};

use super::estimation::{Device, Estimation, check_sequence};
use super::failure::Failure;
use super::output::{complain, say};
use crate::flow::field::Backend;
use crate::flow::{Control, Ego, Estimate, FlowError, Method};
use crate::job::{EgoChoice, JobOptions};
use crate::label::{
    Dataset, Done, Inputs, LabelError, Layout, Place, Plan, RowReport, Shard, Solver, Told,
    finalize, open_plan, run,
};

/// How often progress is a line, where stderr is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Refused pairs that are named at the end.
const NAMED: usize = 10;

/// Label the pairs of many drives.
///
/// Each pair has one output, whose name is a function of the pair, and which is written only where
/// there is none, or where it lacks a sweep that can be read now. So any number of processes may label
/// one manifest, be killed and started again. Give each process a shard, and run
/// `fnsf label ... --finalize` at the end.
///
/// A pair that cannot be labelled is reported and does not stop the others. SIGTERM and Ctrl-C
/// finish the pair that is computed. Exit codes: 0 all is done, 65 some pairs are refused, 75 try
/// again (stopped, or a store failed), 2 wrong arguments.
#[derive(Debug, Args)]
#[command(mut_arg("preset", |argument| argument.default_value("label")))]
#[command(after_help = "Examples:\n  \
    fnsf label drives/ -o labels                            every folder with sweeps is a drive\n  \
    fnsf label av2:/data/av2/val -o labels --known-poses    Argoverse 2 with its poses\n  \
    fnsf label manifest.parquet -o s3://lake/flow/run-7 --shard 17/2000\n  \
    fnsf label manifest.csv -o labels --shard-from-env      in a Slurm array or an Indexed Job\n  \
    fnsf label manifest.csv -o labels --finalize            is all there? one report, _SUCCESS\n\n\
A manifest is CSV or Parquet: columns drive and sweep (a row for each sweep, in order; also time_s or\n\
timestamp_ns, and pose), or source and target (a row for each pair; also drive and id).")]
pub(super) struct Label {
    /// A manifest (.csv, .parquet), or a folder or s3:// prefix with drives. A data set may be named:
    /// av2:PLACE, kitti:PLACE or nuscenes:PLACE
    #[arg(value_name = "MANIFEST")]
    manifest: String,
    /// Folder or s3://, gs:// or az:// prefix for the labels. A folder is made if it is not there
    #[arg(short, long, value_name = "PLACE")]
    output: String,
    /// Do part I of N alone, from 0: consecutive pairs, so that a sweep is read once
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Take the shard from FNSF_SHARD=I/N, the task of a Slurm array, or the index of an Indexed Job
    #[arg(long, conflicts_with = "shard")]
    shard_from_env: bool,
    /// Number of shards, where the environment does not say it; with --finalize those that are named
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    shards: Option<u32>,
    /// What the outputs hold and how they lie
    #[arg(long, value_enum, default_value_t)]
    layout: Layout,
    /// Masks of the rows that av2-v1 asks for: a folder or prefix with DRIVE/TIMESTAMP.feather
    #[arg(long, value_name = "PLACE")]
    masks: Option<String>,
    /// Take the ego motion from the poses of the manifest or of the data set
    #[arg(long)]
    known_poses: bool,
    /// Write DRIVE/tracks.json, and give flows the motions of tracks that their pairs missed. A drive
    /// is then done by one process
    #[arg(long)]
    tracks: bool,
    /// Do not read the times of points: no sweep is deskewed. Otherwise a pair is where it then fits
    /// clearly better, and its flow and boxes are those of the deskewed points
    #[arg(long)]
    ignore_times: bool,
    /// Refuse a pair whose estimate needs more memory than this
    #[arg(long, value_name = "MIB", default_value_t = 8192, value_parser = clap::value_parser!(u32).range(1..))]
    max_memory_mib: u32,
    /// Compare the outputs with the manifest, and write _report.csv and, if all is there, _SUCCESS
    #[arg(long, conflicts_with_all = ["shard", "shard_from_env"])]
    finalize: bool,
    /// Print the result as one JSON object on stdout, instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    estimation: Estimation,
}

impl From<LabelError> for Failure {
    fn from(error: LabelError) -> Self {
        match &error {
            error if error.may_pass() => Self::try_again(anyhow!("{error}")),
            LabelError::OtherRun(_)
            | LabelError::NoPose(_)
            | LabelError::NoConditionalWrites(_) => Self::usage(error),
            _ => Self::bad_input(error),
        }
    }
}

/// The clock of a run. A pair is never interrupted: it is short.
struct Clock(Instant);

impl Control for Clock {
    fn seconds(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }
}

impl Solver for Device<'_> {
    fn solve(
        &mut self,
        work: &dyn Fn(&dyn Backend) -> Result<Estimate, FlowError>,
    ) -> Result<Estimate, FlowError> {
        self.with_fallback(work)
    }
}

/// The result, as `--json` prints it.
#[derive(Serialize)]
struct Summary<'a> {
    shard: String,
    #[serde(flatten)]
    done: &'a Done,
}

/// Whether two places are one: the same folder of this machine, or the same prefix of a bucket.
fn same_place(one: &str, other: &str) -> bool {
    let [one, other] = [one, other].map(|text| {
        let text = text.strip_prefix("file://").unwrap_or(text);
        let folder = Path::new(text).canonicalize();
        folder.unwrap_or_else(|_| text.trim_end_matches('/').into())
    });
    one == other
}

impl Label {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let options = self.options()?;
        let plan = open_plan(&self.manifest)?;
        if !self.output.contains("://") && !self.finalize {
            let made = std::fs::create_dir_all(Path::new(&self.output));
            made.map_err(|error| Failure::usage(anyhow!("{}: {error}", self.output)))?;
        }
        let (_, input) = Dataset::of_place(&self.manifest);
        if !self.finalize && same_place(input, &self.output) {
            let text = "the output is the folder of the sweeps: choose a folder of its own";
            return Err(Failure::usage(anyhow!(text)));
        }
        let output = Place::open(&self.output).map_err(LabelError::from)?;
        match self.finalize {
            true => self.finish(&plan, &output),
            false => self.label(&plan, &options, output),
        }
    }

    fn options(&self) -> Result<JobOptions, Failure> {
        let options = self.estimation.options()?;
        let solver = options.solver_options(0);
        let has_ego_motion = self.known_poses || solver.ego != Ego::Off;
        let refused = if let Some(file) = self.estimation.files().first() {
            Some(format!(
                "{}: poses, motions and rasters of a run are those of its manifest: see --known-poses",
                file.display()
            ))
        } else if self.known_poses && matches!(options.ego, Some(EgoChoice::Off)) {
            Some("--known-poses gives the ego motion that --ego off leaves out".to_owned())
        } else if self.shards.is_some() && !(self.shard_from_env || self.finalize) {
            Some(
                "--shards goes with --shard-from-env or --finalize; one part is --shard I/N"
                    .to_owned(),
            )
        } else if self.layout.needs_masks() != self.masks.is_some() {
            Some("--layout av2-v1 and --masks belong together".to_owned())
        } else if self.tracks && self.layout == Layout::Av2V2 {
            Some("tracks need every pair, and --layout av2-v2 has every fifth".to_owned())
        } else if self.tracks && !matches!(solver.method, Method::Objects(_)) {
            Some("tracks need clusters: use --preset default or label".to_owned())
        } else if self.tracks && !has_ego_motion {
            Some("tracks need the ego motion: leave --ego off away".to_owned())
        } else if self.layout.needs_ego_motion() && !has_ego_motion {
            Some(format!(
                "--layout {} needs the ego motion, which --ego off leaves out: by --preset {} it is given \
                 with --ego auto or --known-poses",
                self.layout.name(),
                options.preset.preset().name()
            ))
        } else {
            None
        };
        match refused {
            Some(refused) => Err(Failure::usage(anyhow!(refused))),
            None => {
                check_sequence(&options, 3)?;
                Ok(options)
            }
        }
    }

    fn shard(&self) -> Result<Shard, Failure> {
        let count = self.shards.map(|count| count as usize);
        match (self.shard, self.shard_from_env) {
            (Some(shard), _) => Ok(shard),
            (None, true) => Shard::from_environment(count).map_err(Failure::usage),
            (None, false) => Ok(Shard::default()),
        }
    }

    fn label(&self, plan: &Plan, options: &JobOptions, output: Place) -> Result<(), Failure> {
        let shard = self.shard()?;
        let masks = self.masks.as_deref().map(Place::open).transpose();
        let masks = masks.map_err(LabelError::from)?;
        let stop = stop_on_signals()?;
        let mut device = self.estimation.open()?;
        let inputs = Inputs {
            plan,
            options,
            layout: self.layout,
            poses: self.known_poses,
            tracks: self.tracks,
            ignore_times: self.ignore_times,
            most_bytes: (self.max_memory_mib as usize) << 20,
            masks,
            shard,
            output,
        };
        let mut shown = Shown::new(shard);
        let clock = Clock(Instant::now());
        let done = run(&inputs, &mut device, &clock, &stop, &mut |told| {
            shown.show(told);
        });
        shown.finish();
        let done = done?;
        self.tell(shard, &done)?;
        if !done.is_complete() {
            let why = match done.stopped {
                true => "it was stopped".to_owned(),
                false => format!("{} pairs failed", done.failed),
            };
            return Err(Failure::try_again(anyhow!(
                "{why}: start it again to go on"
            )));
        }
        match done.refused {
            0 => Ok(()),
            refused => Err(Failure::bad_input(anyhow!(
                "{refused} pairs are refused; the others are done"
            ))),
        }
    }

    fn tell(&self, shard: Shard, done: &Done) -> Result<(), Failure> {
        if self.json {
            let summary = Summary {
                shard: shard.to_string(),
                done,
            };
            let json = serde_json::to_string(&summary).map_err(Failure::internal)?;
            return say(format_args!("{json}"));
        }
        let rate = done.labelled as f64 / done.seconds.max(1e-9);
        say(format_args!(
            "shard {shard}: {} of {} pairs labelled in {:.1} s, {rate:.2} pairs a second",
            done.labelled, done.pairs, done.seconds
        ))?;
        for (count, what) in [
            (done.found, "were there before"),
            (done.raced, "another process labelled meanwhile"),
            (done.refused, "are refused"),
            (done.failed, "failed"),
        ] {
            if count > 0 {
                say(format_args!("  {count} {what}"))?;
            }
        }
        name(&done.troubles)
    }

    fn finish(&self, plan: &Plan, output: &Place) -> Result<(), Failure> {
        let shards = self.shards.unwrap_or(1) as usize;
        let found = finalize(plan, self.layout, output, shards)?;
        say(format_args!(
            "{} pairs: {} labelled, {} refused, {} missing",
            found.pairs,
            found.labelled,
            found.refused.len(),
            found.missing
        ))?;
        if found.lacking_sweeps > 0 {
            say(format_args!(
                "  {} lack a sweep that could not be read; another run tries again",
                found.lacking_sweeps
            ))?;
        }
        say(format_args!("  wrote {}", output.uri("_report.csv")))?;
        name(&found.refused)?;
        if found.is_complete() {
            return say(format_args!("  wrote {}", output.uri("_SUCCESS")));
        }
        let shards: Vec<String> = found.missing_shards.iter().map(Shard::to_string).collect();
        Err(Failure::try_again(anyhow!(
            "{} pairs are missing, in the shards {}",
            found.missing,
            shards.join(" ")
        )))
    }
}

/// Names pairs that are refused or failed, and why.
fn name(troubles: &[RowReport]) -> Result<(), Failure> {
    for report in troubles.iter().take(NAMED) {
        let reason = report.error.as_deref().unwrap_or("no reason is known");
        say(format_args!("  {}: {reason}", report.key))?;
    }
    match troubles.len().checked_sub(NAMED) {
        Some(more @ 1..) => say(format_args!("  and {more} more, see _report.csv")),
        _ => Ok(()),
    }
}

/// A flag that SIGTERM and SIGINT set. A second signal ends the program at once.
fn stop_on_signals() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    let told = Arc::clone(&stop);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(Failure::internal)?;
    let waiting = move || -> std::io::Result<()> {
        runtime.block_on(async {
            let mut ends = signal(SignalKind::terminate())?;
            let mut interrupts = signal(SignalKind::interrupt())?;
            let mut next = async || {
                tokio::select! {
                    _ = ends.recv() => SignalKind::terminate(),
                    _ = interrupts.recv() => SignalKind::interrupt(),
                }
            };
            next().await;
            told.store(true, Ordering::Relaxed);
            complain(format_args!(
                "the pair that is computed is finished; a second signal ends at once"
            ));
            let number = next().await.as_raw_value();
            process::exit(128 + number)
        })
    };
    std::thread::Builder::new()
        .name("signals".to_owned())
        .spawn(move || waiting().unwrap_or_default())
        .map_err(Failure::internal)?;
    Ok(stop)
}

/// The progress of a run: a bar on a terminal, otherwise a line now and then.
struct Shown {
    shard: Shard,
    bar: ProgressBar,
    last: Instant,
}

impl Shown {
    fn new(shard: Shard) -> Self {
        let style =
            ProgressStyle::with_template("{spinner} {msg}  {wide_bar:.cyan/blue} {pos} of {len}");
        // indicatif hides the bar where stderr is no terminal.
        let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        bar.set_message("reading");
        bar.tick();
        Self {
            shard,
            bar,
            last: Instant::now(),
        }
    }

    fn show(&mut self, told: &Told) {
        let rate = told.pairs_per_second;
        let left = told.seconds_left;
        let refused = match told.refused {
            0 => String::new(),
            refused => format!(", {refused} refused"),
        };
        let text = format!("{rate:.2} pairs a second, {left:.0} s left{refused}");
        if self.bar.is_hidden() {
            if self.last.elapsed() >= LINE_EVERY {
                self.last = Instant::now();
                let (shard, done, total) = (self.shard, told.done, told.total);
                complain(format_args!(
                    "shard {shard}: {done} of {total} pairs, {text}"
                ));
            }
            return;
        }
        self.bar.set_length(told.total as u64);
        self.bar.set_position(told.done as u64);
        self.bar.set_message(text);
    }

    fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
