//! The `eval` command.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;

use super::print::{print, print_buckets, print_heading, print_row};
use super::tracks;
use crate::cli::failure::Failure;
use crate::cli::files;
use crate::cli::output::show;
use crate::formats::{FlowFile, Pair, PairTruth};
use crate::scores::{Report, Scores};

/// Compare flow files, or files of tracks, with ground truth.
///
/// A point is scored if it is valid in the truth, not ground, and has a flow. End-point errors
/// (EPE) are in metres, over the time from the source sweep to the target. For several flows, each
/// has a row, and the last row is for all their points together.
///
/// Tracks (.json, as `fnsf flow --tracks` writes them) are compared with true tracks by the
/// distance of centers in the plane, up to 2 m. True objects of 1 m/s and ten points or more are to
/// be found, the others count neither for nor against.
#[derive(Debug, Args)]
#[command(override_usage = "fnsf eval FLOW... --truth TRUTH... [OPTIONS]")]
#[command(after_help = "Examples:\n  \
    fnsf eval flow.npz --truth pair.npz\n  \
    fnsf eval flow.feather --truth flow_labels.feather --source sweep.feather --json\n  \
    fnsf eval flows/*.npz --truth pairs/*.npz\n  \
    fnsf eval tracks.json --truth street/tracks.json")]
pub(crate) struct Eval {
    /// Flows in any format that `fnsf flow` writes, or tracks
    #[arg(required = true, value_name = "FLOW")]
    flows: Vec<PathBuf>,
    /// Ground truth of each flow, in the same order: an .npz pair with `flow` and `valid`, or
    /// Argoverse 2's flow_labels.feather; or true tracks
    #[arg(long, value_name = "TRUTH", required = true, num_args = 1..)]
    truth: Vec<PathBuf>,
    /// Source sweep of each flow, in the same order. Needed for the three-way and the
    /// bucket-normalized EPE where the truth does not contain it
    #[arg(long, value_name = "SWEEP", num_args = 1..)]
    source: Vec<PathBuf>,
    /// True ego motion of each flow, in the same order: a file with the 4 x 4 matrix
    /// target_from_source. Needed for the bucket-normalized EPE where the truth does not contain it
    #[arg(long, value_name = "FILE", num_args = 1..)]
    ego: Vec<PathBuf>,
    /// Print JSON on stdout, instead of text: one object a line for each flow and, for several
    /// flows, one for all together
    #[arg(long)]
    json: bool,
}

/// Prints how good a flow is, for people.
pub(crate) fn print_score(flow: &FlowFile, truth: &PairTruth, pair: &Pair) -> Result<(), Failure> {
    let mut scores = Scores::default();
    scores.add(flow, truth, pair).map_err(Failure::bad_input)?;
    print(&scores.report(None).map_err(Failure::bad_input)?)
}

impl Eval {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let flows = self.flows.len();
        for (what, files) in [
            ("--truth", &self.truth),
            ("--source", &self.source),
            ("--ego", &self.ego),
        ] {
            if files.len() != flows && !(files.is_empty() && what != "--truth") {
                return Err(Failure::usage(anyhow!(
                    "{flows} flows but {} after {what}: one each is needed, in the same order",
                    files.len()
                )));
            }
        }
        if files::is_tracks(&self.flows[0])? {
            if !self.source.is_empty() || !self.ego.is_empty() {
                let text = "--source and --ego are for flows, and the first file has tracks";
                return Err(Failure::usage(anyhow!(text)));
            }
            return tracks::run(&self.flows, &self.truth, self.json);
        }
        let names: Vec<String> = self
            .flows
            .iter()
            .map(|path| path.display().to_string())
            .collect();
        let width = names.iter().map(String::len).fold("flow".len(), usize::max);
        if flows > 1 && !self.json {
            print_heading(width)?;
        }
        let mut all = Scores::default();
        for (index, name) in names.iter().enumerate() {
            let (flow, truth, pair) = self.read(index)?;
            let mut scores = Scores::default();
            // One flow has no total.
            let total = (flows > 1).then_some(&mut all);
            for scores in [Some(&mut scores), total].into_iter().flatten() {
                let added = scores
                    .add(&flow, &truth, &pair)
                    .with_context(|| name.clone());
                added.map_err(Failure::bad_input)?;
            }
            let of = (flows > 1).then(|| name.clone());
            let report = scores.report(of).with_context(|| name.clone());
            let report = report.map_err(Failure::bad_input)?;
            if self.json {
                print_json(&report)?;
            } else if flows > 1 {
                print_row(&report, name, width)?;
            } else {
                print(&report)?;
            }
        }
        if flows > 1 {
            let report = all.report(None).map_err(Failure::bad_input)?;
            if self.json {
                print_json(&report)?;
            } else {
                print_row(&report, "all", width)?;
                print_buckets(&report)?;
            }
        }
        Ok(())
    }

    /// Reads flow number `index`, its truth, and the other data of the pair.
    fn read(&self, index: usize) -> Result<(FlowFile, PairTruth, Pair), Failure> {
        let flow = files::read_flow(&self.flows[index])?;
        let (truth, mut pair) = files::read_truth(&self.truth[index])?;
        if let Some(source) = self.source.get(index) {
            pair.source = files::read_cloud(source)?;
        }
        if let Some(ego) = self.ego.get(index) {
            pair.ego = Some(files::read_motion(ego)?);
        }
        Ok((flow, truth, pair))
    }
}

fn print_json(report: &Report) -> Result<(), Failure> {
    let json = serde_json::to_string(report).map_err(Failure::internal)?;
    show(format_args!("{json}"))
}
