//! The end of a run: is everything there, one report, and `_SUCCESS`.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::time::Duration;

use bytes::Bytes;
use tokio::runtime::Builder;

use super::error::LabelError;
use super::layout::{Layout, SETTINGS_FILE, check_outputs, left_out_path, tracks_path};
use super::places::{Place, PlaceError};
use super::plan::Plan;
use super::report::{Outcome, RowReport, read_lines};
use super::settings::Settings;
use super::shard::Shard;

/// The report of all pairs.
const REPORT: &str = "_report.csv";
/// A write that has not ended after this time has been cut off.
const CUT_OFF: Duration = Duration::from_secs(3600);
/// Says that every pair is labelled or refused.
const SUCCESS: &str = "_SUCCESS";

/// What a run has come to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Finalized {
    /// Pairs of the plan that the layout asks for.
    pub pairs: usize,
    /// Pairs whose output is there.
    pub labelled: usize,
    /// Labelled pairs that another run is to label again: a sweep of theirs or around them could not be
    /// read.
    pub lacking_sweeps: usize,
    /// Pairs that cannot be labelled.
    pub refused: Vec<RowReport>,
    /// Pairs that are to be tried again.
    pub missing: usize,
    /// The shards of `count` that hold the missing pairs.
    pub missing_shards: Vec<Shard>,
}

impl Finalized {
    /// Whether nothing is missing.
    pub fn is_complete(&self) -> bool {
        self.missing == 0
    }
}

/// Compares the outputs with the plan. Writes `_report.csv`, and `_SUCCESS` where nothing is missing;
/// otherwise removes it.
/// `shards` is the number of shards by which missing pairs are named.
///
/// # Errors
/// [`LabelError`].
pub fn finalize(
    plan: &Plan,
    layout: Layout,
    output: &Place,
    shards: usize,
) -> Result<Finalized, LabelError> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let settings = Settings::read(output).await?;
        if settings.layout != layout.name() || settings.plan != plan.hash(settings.poses) {
            return Err(LabelError::BadRun(
                output.uri(SETTINGS_FILE),
                "it is of another manifest or another layout".to_owned(),
            ));
        }
        check_outputs(plan, layout, settings.tracks)?;
        output.remove_cut_off(CUT_OFF)?;
        let all: HashSet<String> = output.all("").await?.into_iter().collect();
        // The latest report of each pair, and the latest that tells of its output.
        let mut latest: HashMap<String, RowReport> = HashMap::new();
        let mut labelled: HashMap<String, RowReport> = HashMap::new();
        // The names begin with the time of the attempt.
        let is_part = |path: &&String| path.starts_with("_report/");
        let parts: BTreeSet<&String> = all.iter().filter(is_part).collect();
        for part in parts {
            for report in read_lines(&output.read(part).await?) {
                if report.is_there() {
                    labelled.insert(report.key.clone(), report.clone());
                }
                latest.insert(report.key.clone(), report);
            }
        }
        let mut found = Finalized::default();
        let mut missing: BTreeSet<usize> = BTreeSet::new();
        let before = plan.pairs_before();
        let mut table = csv::Writer::from_writer(Vec::new());
        let heading = [
            "key", "source", "target", "outcome", "error", "seconds", "points", "moving",
            "overlap", "deskewed", "left_out", "warnings",
        ];
        let unwritten = |error: csv::Error| LabelError::Machine(std::io::Error::other(error));
        table.write_record(heading).map_err(unwritten)?;
        let whole = settings.tracks;
        for (drive, pair) in plan.all_pairs().filter(|&(_, pair)| layout.asks_for(pair)) {
            let of = &plan.drives()[drive];
            let key = of.key(pair);
            let path = layout.path(&of.name, pair, &key);
            let has_flow = all.contains(&path);
            let lacks_sweep = all.contains(&left_out_path(&path));
            let is_there = has_flow && (!whole || all.contains(&tracks_path(&of.name)));
            let last = latest.get(&key);
            let report = labelled.get(&key).filter(|_| is_there).or(last);
            // A flow without the tracks of its drive is of a run that was interrupted.
            let refused = last.filter(|last| !has_flow && last.outcome == Outcome::Refused);
            found.pairs += 1;
            let outcome = match (is_there, refused) {
                (true, _) => {
                    found.labelled += 1;
                    found.lacking_sweeps += usize::from(lacks_sweep);
                    "labelled"
                }
                (false, Some(refused)) => {
                    found.refused.push(refused.clone());
                    "refused"
                }
                (false, None) => {
                    found.missing += 1;
                    let number = before[drive] + if whole { 0 } else { pair };
                    missing.insert(Shard::of(number, plan.pairs(), shards));
                    "missing"
                }
            };
            let number = |value: Option<String>| value.unwrap_or_default();
            table
                .write_record([
                    key.clone(),
                    of.sweeps[pair].uri.clone(),
                    of.sweeps[pair + 1].uri.clone(),
                    outcome.to_owned(),
                    number(report.and_then(|of| of.error.clone())),
                    number(report.and_then(|of| of.seconds).map(|s| format!("{s:.4}"))),
                    number(report.and_then(|of| of.points).map(|n| n.to_string())),
                    number(report.and_then(|of| of.moving).map(|n| n.to_string())),
                    number(report.and_then(|of| of.overlap).map(|o| format!("{o:.4}"))),
                    number(report.and_then(|of| of.deskewed).map(|is| is.to_string())),
                    number(report.map(|of| match lacks_sweep {
                        true => of.left_out.len().to_string(),
                        false => "0".to_owned(),
                    })),
                    number(report.map(|of| of.warnings.join("; "))),
                ])
                .map_err(unwritten)?;
        }
        let bytes = table
            .into_inner()
            .map_err(|error| unwritten(error.into_error().into()))?;
        if !found.is_complete() {
            match output.remove(SUCCESS).await {
                Ok(()) | Err(PlaceError::Missing(_)) => {}
                Err(error) => return Err(error.into()),
            }
        }
        output.put(REPORT, Bytes::from(bytes)).await?;
        if found.is_complete() {
            let text = format!(
                "{} labelled, {} refused\n",
                found.labelled,
                found.refused.len()
            );
            output.put(SUCCESS, Bytes::from(text)).await?;
        } else {
            let shard = |index| Shard {
                index,
                count: shards,
            };
            found.missing_shards = missing.into_iter().map(shard).collect();
        }
        Ok(found)
    })
}
