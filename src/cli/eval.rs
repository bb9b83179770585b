//! `fnsf eval`: how good a flow file is.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::failure::Failure;
use super::files;
use super::output::say;
use crate::flow::evaluate::{
    Argoverse2, Metrics, Part, ThreeWay, Truth, evaluate, evaluate_argoverse2,
};
use crate::formats::{FlowFile, Pair, PairTruth};
use crate::text::grouped;

/// Compare a flow file with ground truth.
///
/// Scored are the points that are valid in the truth, not ground, and covered by the flow.
/// End-point errors are in metres over the gap between the sweeps.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf eval flow.npz --truth pair.npz\n  \
    fnsf eval flow.feather --truth flow_labels.feather --source sweep.feather --json")]
pub(super) struct Eval {
    /// A flow in any format that `fnsf flow` writes
    flow: PathBuf,
    /// An .npz pair with `flow` and `valid`, or Argoverse 2's flow_labels.feather
    #[arg(long, value_name = "TRUTH")]
    truth: PathBuf,
    /// The source sweep, for the three-way error, where the truth does not hold it
    #[arg(long, value_name = "SWEEP")]
    source: Option<PathBuf>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
}

/// What `--json` prints.
#[derive(Debug, Serialize)]
struct Report {
    points: usize,
    epe: f64,
    acc5: f64,
    acc10: f64,
    outliers: f64,
    angle_error: f64,
    epe_dynamic: Option<f64>,
    epe_static: Option<f64>,
    three_way: Option<ThreeWayReport>,
    argoverse2: Argoverse2Report,
}

#[derive(Debug, Serialize)]
struct ThreeWayReport {
    epe: Option<f64>,
    foreground_dynamic: Option<f64>,
    foreground_static: Option<f64>,
    background_static: Option<f64>,
    points: [usize; 3],
}

#[derive(Debug, Serialize)]
struct Argoverse2Report {
    accuracy_strict: f64,
    accuracy_relax: f64,
    angle_error: f64,
    dynamic_iou: Option<f64>,
    three_way: Option<ThreeWayReport>,
}

impl From<ThreeWay> for ThreeWayReport {
    fn from(three_way: ThreeWay) -> Self {
        let parts: [Part; 3] = [
            three_way.foreground_dynamic,
            three_way.foreground_static,
            three_way.background_static,
        ];
        Self {
            epe: three_way.epe,
            foreground_dynamic: parts[0].epe,
            foreground_static: parts[1].epe,
            background_static: parts[2].epe,
            points: parts.map(|part| part.points),
        }
    }
}

impl Report {
    fn new(metrics: Metrics, argoverse2: Argoverse2) -> Self {
        Self {
            points: metrics.points,
            epe: metrics.epe,
            acc5: metrics.acc5,
            acc10: metrics.acc10,
            outliers: metrics.outliers,
            angle_error: metrics.angle_error,
            epe_dynamic: metrics.epe_dynamic,
            epe_static: metrics.epe_static,
            three_way: metrics.three_way.map(ThreeWayReport::from),
            argoverse2: Argoverse2Report {
                accuracy_strict: argoverse2.accuracy_strict,
                accuracy_relax: argoverse2.accuracy_relax,
                angle_error: argoverse2.angle_error,
                dynamic_iou: argoverse2.dynamic_iou,
                three_way: argoverse2.three_way.map(ThreeWayReport::from),
            },
        }
    }

    /// What a person reads.
    fn print(&self) -> Result<(), Failure> {
        let metres = |value: Option<f64>| value.map_or("-".to_owned(), |m| format!("{m:.4} m"));
        say(format_args!("{} points scored", grouped(self.points)))?;
        say(format_args!("  EPE          {:.4} m", self.epe))?;
        say(format_args!("    moving     {}", metres(self.epe_dynamic)))?;
        say(format_args!("    static     {}", metres(self.epe_static)))?;
        say(format_args!(
            "  Acc5, Acc10  {:.4}, {:.4}",
            self.acc5, self.acc10
        ))?;
        say(format_args!("  outliers     {:.4}", self.outliers))?;
        say(format_args!("  angle        {:.4} rad", self.angle_error))?;
        if let Some(three_way) = &self.three_way {
            say(format_args!(
                "  three-way    {} (within 35 m)",
                metres(three_way.epe)
            ))?;
        }
        if let Some(iou) = self.argoverse2.dynamic_iou {
            say(format_args!("  moving IoU   {iou:.4}"))?;
        }
        Ok(())
    }
}

/// Scores `flow` against a truth and what else is known of the pair.
fn score(flow: &FlowFile, truth: &PairTruth, pair: &Pair) -> Result<Report, Failure> {
    let source = (!pair.source.is_empty()).then_some(pair.source.as_slice());
    let truth = Truth {
        flow: &truth.flow,
        valid: &truth.valid,
        dynamic: truth.dynamic.as_deref(),
        foreground: truth.foreground.as_deref(),
        ground: pair.ground.as_ref().map(|ground| ground.source.as_slice()),
        source,
        ego: pair.ego.as_ref(),
    };
    let everywhere = vec![true; flow.flow.len()];
    let covered = flow.valid.as_deref().unwrap_or(&everywhere);
    let metrics = evaluate(&flow.flow, covered, &truth).map_err(Failure::bad_input)?;
    let argoverse2 = evaluate_argoverse2(&flow.flow, covered, flow.dynamic.as_deref(), &truth)
        .map_err(Failure::bad_input)?;
    Ok(Report::new(metrics, argoverse2))
}

/// Prints how good a flow is, for people.
pub(super) fn print_score(flow: &FlowFile, truth: &PairTruth, pair: &Pair) -> Result<(), Failure> {
    score(flow, truth, pair)?.print()
}

impl Eval {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let flow = files::read_flow(&self.flow)?;
        let (truth, mut pair) = files::read_truth(&self.truth)?;
        if let Some(source) = &self.source {
            pair.source = files::read_cloud(source)?;
        }
        let report = score(&flow, &truth, &pair)?;
        if self.json {
            let json = serde_json::to_string(&report).map_err(Failure::internal)?;
            say(format_args!("{json}"))?;
        } else {
            report.print()?;
        }
        Ok(())
    }
}
