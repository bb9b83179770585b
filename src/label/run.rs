//! A run: one process labels the pairs of its shard.

use std::collections::HashSet;
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::time::Instant;

use tokio::runtime::{Builder, Runtime};

use super::datasets::{Dataset, drives_of};
use super::error::LabelError;
use super::io::{Io, Wanted};
use super::layout::{LEFT_OUT, check_outputs, left_out_path, tracks_path};
use super::manifest::read_manifest;
use super::pipeline::label;
use super::places::{Place, PlaceError, Places};
use super::plan::Plan;
use super::settings::Settings;
use super::types::{Done, Inputs, Solver, Told};
use crate::flow::Control;

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
        Ok(drives_of(dataset, &place).await?)
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
        if !drive.is_empty() {
            let marks = format!("{LEFT_OUT}/{drive}");
            found.extend(inputs.output.all(&marks).await?);
        }
    }
    Ok(found)
}

/// The number of pairs of a shard, and those of them that are to be computed.
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
            let has_tracks = inputs.tracks && present.contains(&tracks_path(&of.name));
            Wanted {
                drive,
                pair,
                is_there: present.contains(&path),
                is_marked: present.contains(&left_out_path(&path)),
                has_tracks,
                path,
            }
        })
        .collect();
    let is_done = |wanted: &Wanted| wanted.is_there && !wanted.is_marked;
    match inputs.tracks {
        // Tracks need all pairs of their drive.
        true => {
            all = all
                .chunk_by(|one, next| one.drive == next.drive)
                .filter(|drive| !(drive[0].has_tracks && drive.iter().all(is_done)))
                .flatten()
                .cloned()
                .collect();
        }
        false => all.retain(|wanted| !is_done(wanted)),
    }
    Ok((total, all))
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
    check_outputs(inputs.plan, inputs.layout, inputs.tracks)?;
    if !inputs.options.force {
        inputs.plan.check_order()?;
    }
    if inputs.poses {
        for drive in inputs.plan.drives() {
            if let Some(sweep) = drive.sweeps.iter().find(|sweep| sweep.pose.is_none()) {
                let none = || format!("{} has no pose", sweep.uri);
                return Err(LabelError::NoPose(
                    drive.bad_poses.clone().unwrap_or_else(none),
                ));
            }
        }
    }
    let runtime = runtime()?;
    let (total, wanted) = runtime.block_on(async {
        check_conditional_writes(&inputs.output).await?;
        Settings::new(inputs).agree(&inputs.output).await?;
        for (name, text) in inputs.layout.run_files() {
            inputs.output.put_new(name, (*text).into()).await?;
        }
        wanted(inputs).await
    })?;
    let io = Io {
        inputs,
        runtime: &runtime,
        stop,
        left_alone: &AtomicUsize::new(usize::MAX),
    };
    let mut done = label(&io, &wanted, total, solver, control, told)?;
    done.seconds = began.elapsed().as_secs_f64();
    Ok(done)
}
