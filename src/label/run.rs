//! A run: one process labels the pairs of its shard.

use std::collections::HashSet;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use tokio::runtime::{Builder, Runtime};

use super::datasets::{Dataset, DatasetError};
use super::layout::Layout;
use super::manifest::{ManifestError, read_manifest};
use super::pipeline::{Pipeline, Wanted};
use super::places::{Place, PlaceError, Places};
use super::plan::{Plan, PlanError};
use super::report::RowReport;
use super::settings::{OtherRun, Settings};
use super::shard::Shard;
use crate::flow::field::Backend;
use crate::flow::{Control, Estimate, FlowError};
use crate::job::JobOptions;

/// Why a run cannot begin, or had to stop.
#[derive(Debug, thiserror::Error)]
pub enum LabelError {
    /// A store cannot be used.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// The manifest cannot be used.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The data set cannot be used.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// There is nothing to label.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The output belongs to a run with other settings.
    #[error(transparent)]
    OtherRun(OtherRun),
    /// The output holds no run.
    #[error("{0} holds no run: it has no run.json")]
    NoRun(String),
    /// The settings of the output cannot be read.
    #[error("{0} cannot be read: {1}")]
    BadRun(String, String),
    /// A sweep has no pose, and the ego motion is to come from poses.
    #[error("{0} has no pose: leave out --known-poses, or give every sweep of the manifest one")]
    NoPose(String),
    /// The output does not keep the first of two writers.
    #[error(
        "{0} replaces an object that is there although it was asked not to: choose a store with conditional writes"
    )]
    NoConditionalWrites(String),
    /// The machine cannot start what the run needs.
    #[error("the run cannot start: {0}")]
    Machine(#[from] std::io::Error),
}

impl LabelError {
    /// Whether trying again may help.
    pub fn may_pass(&self) -> bool {
        match self {
            Self::Place(error) | Self::Dataset(DatasetError::Place(error)) => error.may_pass(),
            Self::Machine(_) => true,
            _ => false,
        }
    }
}

/// What is labelled, how, and where to.
#[derive(Clone, Debug)]
pub struct Inputs<'a> {
    /// All pairs.
    pub plan: &'a Plan,
    /// The options of the estimates.
    pub options: &'a JobOptions,
    /// How the outputs lie.
    pub layout: Layout,
    /// Whether the ego motion is that of the plan's poses.
    pub poses: bool,
    /// Whether tracks are written, and correct the flows. A drive is then done by one process.
    pub tracks: bool,
    /// Where the masks of [`Layout::needs_masks`] are: `DRIVE/TIMESTAMP.feather` with a column `mask`.
    pub masks: Option<Place>,
    /// The part of the plan.
    pub shard: Shard,
    /// Where the outputs go.
    pub output: Place,
}

/// Computes estimates, on a device that it may exchange.
pub trait Solver {
    /// Does `work` on its device.
    ///
    /// # Errors
    /// Those of `work`.
    fn solve(
        &mut self,
        work: &dyn Fn(&dyn Backend) -> Result<Estimate, FlowError>,
    ) -> Result<Estimate, FlowError>;
}

/// How far a run is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Told {
    /// Pairs of the shard whose output is there, or that were refused.
    pub done: usize,
    /// Pairs of the shard.
    pub total: usize,
    /// Pairs that were refused.
    pub refused: usize,
    /// Pairs a second of this process.
    pub pairs_per_second: f64,
    /// Seconds to the end at this rate.
    pub seconds_left: f64,
}

/// The end of a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Done {
    /// Pairs of the shard.
    pub pairs: usize,
    /// Pairs whose output was there before.
    pub found: usize,
    /// Pairs that this process labelled.
    pub labelled: usize,
    /// Pairs that another process labelled meanwhile.
    pub raced: usize,
    /// Pairs that cannot be labelled.
    pub refused: usize,
    /// Pairs that failed, and may succeed when they are tried again.
    pub failed: usize,
    /// Whether it was asked to stop before the end.
    pub stopped: bool,
    /// Seconds of the whole run.
    pub seconds: f64,
    /// The reports of refused and failed pairs.
    pub troubles: Vec<RowReport>,
}

impl Done {
    /// Whether nothing is left to try again.
    pub fn is_complete(&self) -> bool {
        self.failed == 0 && !self.stopped
    }
}

fn runtime() -> Result<Runtime, LabelError> {
    Ok(Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?)
}

/// Opens what is to be labelled: a manifest (`.csv`, `.parquet`), a folder or prefix with drives, or
/// either with the name of its data set before it, as `av2:/data/av2/val`.
///
/// # Errors
/// [`LabelError`].
pub fn open_plan(text: &str) -> Result<Plan, LabelError> {
    let (dataset, place) = Dataset::of_place(text);
    let drives = runtime()?.block_on(async {
        let is_table = [".csv", ".parquet"].iter().any(|end| place.ends_with(end));
        if is_table && dataset.is_none() {
            let bytes = Places::default().read(place).await?;
            let folder = place.rsplit_once('/').map(|(folder, _)| folder);
            return Ok::<_, LabelError>(read_manifest(bytes, folder)?);
        }
        let place = Places::default().open(place)?;
        Ok(Dataset::drives(dataset, &place).await?)
    })?;
    Ok(Plan::new(drives)?)
}

/// Checks that an object that is there is not replaced.
async fn check_conditional_writes(output: &Place) -> Result<(), LabelError> {
    let path = format!("_probe-{}", uuid::Uuid::now_v7());
    let first = output.put_new(&path, "1".into()).await?;
    let second = output.put_new(&path, "2".into()).await?;
    output.remove(&path).await?;
    match (first, second) {
        (true, false) => Ok(()),
        _ => Err(LabelError::NoConditionalWrites(output.uri(""))),
    }
}

/// The outputs that are there. Drives of the shard are listed one by one where they are few.
async fn present(
    inputs: &Inputs<'_>,
    pairs: &[(usize, usize)],
) -> Result<HashSet<String>, PlaceError> {
    const FEW: usize = 50;
    let mut drives: Vec<&str> = pairs
        .iter()
        .map(|&(drive, _)| inputs.plan.drives()[drive].name.as_str())
        .collect();
    drives.dedup();
    if drives.len() > FEW || drives.iter().any(|name| name.is_empty()) {
        drives = vec![""];
    }
    let mut found = HashSet::new();
    for drive in drives {
        found.extend(inputs.output.all(drive).await?);
    }
    Ok(found)
}

/// The pairs of a shard, and those of them whose outputs are not there.
async fn wanted(inputs: &Inputs<'_>) -> Result<(usize, Vec<Wanted>), LabelError> {
    let (plan, layout) = (inputs.plan, inputs.layout);
    let mut pairs = inputs.shard.pairs(plan, inputs.tracks);
    pairs.retain(|&(_, pair)| layout.asks_for(pair));
    let present = present(inputs, &pairs).await?;
    let total = pairs.len();
    let mut all: Vec<Wanted> = pairs
        .into_iter()
        .map(|(drive, pair)| {
            let of = &plan.drives()[drive];
            let path = layout.path(&of.name, pair, &of.key(pair));
            let is_there = present.contains(&path);
            Wanted {
                drive,
                pair,
                path,
                is_there,
            }
        })
        .collect();
    if inputs.tracks {
        // Tracks need all pairs of a drive: it is done again unless all of it is there.
        let unfinished: HashSet<usize> = all
            .iter()
            .filter(|wanted| {
                let tracks = tracks_path(&plan.drives()[wanted.drive].name);
                !wanted.is_there || !present.contains(&tracks)
            })
            .map(|wanted| wanted.drive)
            .collect();
        all.retain(|wanted| unfinished.contains(&wanted.drive));
    } else {
        all.retain(|wanted| !wanted.is_there);
    }
    Ok((total, all))
}

/// The file of a drive's tracks.
pub(super) fn tracks_path(drive: &str) -> String {
    match drive.is_empty() {
        true => "tracks.json".to_owned(),
        false => format!("{drive}/tracks.json"),
    }
}

/// Labels the pairs of a shard whose outputs are not there. When `stop` becomes true, the pair that
/// is computed is finished. `told` is called after every pair.
///
/// # Errors
/// [`LabelError`]. Pairs that cannot be labelled are no error, see [`Done`].
pub fn run(
    inputs: &Inputs<'_>,
    solver: &mut dyn Solver,
    control: &dyn Control,
    stop: &AtomicBool,
    told: &mut dyn FnMut(&Told),
) -> Result<Done, LabelError> {
    let began = Instant::now();
    if inputs.poses {
        let sweeps = inputs.plan.drives().iter().flat_map(|drive| &drive.sweeps);
        if let Some(sweep) = sweeps.into_iter().find(|sweep| sweep.pose.is_none()) {
            return Err(LabelError::NoPose(sweep.uri.clone()));
        }
    }
    let runtime = runtime()?;
    let (total, wanted) = runtime.block_on(async {
        check_conditional_writes(&inputs.output).await?;
        let flags = [inputs.poses, inputs.tracks];
        let settings = Settings::new(inputs.plan, inputs.options, inputs.layout, flags);
        settings.agree(&inputs.output).await?;
        for (name, text) in inputs.layout.run_files() {
            inputs.output.put_new(name, (*text).into()).await?;
        }
        wanted(inputs).await
    })?;
    let pipeline = Pipeline {
        inputs,
        runtime: &runtime,
        wanted: &wanted,
        total,
        stop,
    };
    let mut done = pipeline.run(solver, control, told)?;
    done.seconds = began.elapsed().as_secs_f64();
    Ok(done)
}
