//! Scores of flow files: accumulated over pairs, and printed as JSON or text.

use serde::Serialize;

use super::buckets::BucketNormalizedReport;
use crate::cli::failure::Failure;
use crate::cli::output::say;
use crate::flow::evaluate::{
    Argoverse2Pool, BucketNormalized, CLASSES, Calibration, EvaluateError, Part, Pool, Reliability,
    ThreeWay, Truth, class_of_category, class_of_foreground,
};
use crate::formats::{FlowFile, Pair, PairTruth};
use crate::text::grouped;

/// The truth of a pair, with the masks, the source and the ego motion that are known.
pub(in crate::cli) fn truth_of<'a>(known: &'a PairTruth, pair: &'a Pair) -> Truth<'a> {
    Truth {
        flow: &known.flow,
        valid: &known.valid,
        dynamic: known.dynamic.as_deref(),
        foreground: known.foreground.as_deref(),
        ground: pair.ground.as_ref().map(|ground| ground.source.as_slice()),
        source: (!pair.source.is_empty()).then_some(pair.source.as_slice()),
        ego: pair.ego.as_ref(),
    }
}

/// The scores of one flow, or of several together. Every scored point weighs the same, except in
/// the bucket-normalized EPE, which is a mean over classes and speeds.
pub(super) struct Scores {
    paper: Pool,
    argoverse2: Argoverse2Pool,
    buckets: BucketNormalized,
    confidence: Reliability,
    moving: Reliability,
}

impl Default for Scores {
    fn default() -> Self {
        Self {
            paper: Pool::default(),
            argoverse2: Argoverse2Pool::default(),
            buckets: BucketNormalized::new(CLASSES.len() as u8),
            confidence: Reliability::default(),
            moving: Reliability::default(),
        }
    }
}

impl Scores {
    /// Adds one pair: its flow, its truth, and the other data of the pair.
    pub(super) fn add(
        &mut self,
        flow: &FlowFile,
        known: &PairTruth,
        pair: &Pair,
    ) -> Result<(), EvaluateError> {
        let truth = truth_of(known, pair);
        let everywhere = vec![true; flow.flow.len()];
        let covered = flow.valid.as_deref().unwrap_or(&everywhere);
        self.paper.add(&flow.flow, covered, &truth)?;
        self.argoverse2
            .add(&flow.flow, covered, flow.dynamic.as_deref(), &truth)?;
        let classes: Option<Vec<u8>> = match (&known.category, &known.foreground) {
            (Some(category), _) => Some(category.iter().map(|&c| class_of_category(c)).collect()),
            (None, Some(on)) => Some(on.iter().map(|&on| class_of_foreground(on)).collect()),
            (None, None) => None,
        };
        if let Some(classes) = classes
            && truth.source.is_some()
            && truth.ego.is_some()
        {
            self.buckets.add(&flow.flow, covered, &classes, &truth)?;
        }
        if let Some(confidence) = &flow.confidence {
            self.confidence
                .add_confidence(&flow.flow, covered, confidence, &truth)?;
        }
        if let Some(moving) = &flow.moving
            && truth.dynamic.is_some()
        {
            self.moving
                .add_moving(&flow.flow, covered, moving, &truth)?;
        }
        Ok(())
    }

    /// The scores of all flows added; `flow` is the name of the flow where there is only one.
    pub(super) fn report(&self, flow: Option<String>) -> Result<Report, EvaluateError> {
        let metrics = self.paper.finish()?;
        let argoverse2 = self.argoverse2.finish()?;
        Ok(Report {
            flow,
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
            bucket_normalized: BucketNormalizedReport::new(&self.buckets.finish()),
            confidence: self.confidence.finish().map(ConfidenceReport::from),
            moving: self.moving.finish().map(MovingReport::from),
        })
    }
}

/// The scores, as `--json` prints them: errors in metres, angles in radians, shares from 0 to 1.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    #[serde(skip_serializing_if = "Option::is_none")]
    flow: Option<String>,
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
    bucket_normalized: Option<BucketNormalizedReport>,
    confidence: Option<ConfidenceReport>,
    moving: Option<MovingReport>,
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

#[derive(Debug, Serialize)]
struct ConfidenceReport {
    calibration_error: f64,
    sure_half_epe: f64,
    rest_epe: f64,
}

/// The chance that a point moves. Recall and precision are of the points with 0.5 or more; null where
/// none moves, or none has that.
#[derive(Debug, Serialize)]
struct MovingReport {
    calibration_error: f64,
    recall: Option<f64>,
    precision: Option<f64>,
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

impl From<Calibration> for ConfidenceReport {
    fn from(calibration: Calibration) -> Self {
        Self {
            calibration_error: calibration.error,
            sure_half_epe: calibration.sure_half_epe,
            rest_epe: calibration.rest_epe,
        }
    }
}

impl From<Calibration> for MovingReport {
    fn from(calibration: Calibration) -> Self {
        Self {
            calibration_error: calibration.error,
            recall: calibration.recall,
            precision: calibration.precision,
        }
    }
}

impl Report {
    /// Prints the scores as text.
    pub(super) fn print(&self) -> Result<(), Failure> {
        let metres = |value: Option<f64>| value.map_or("-".to_owned(), |m| format!("{m:.4} m"));
        let share = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.3}"));
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
        if let Some(confidence) = &self.confidence {
            say(format_args!(
                "  confidence   surer half {:.4} m, rest {:.4} m, calibration error {:.3}",
                confidence.sure_half_epe, confidence.rest_epe, confidence.calibration_error
            ))?;
        }
        if let Some(moving) = &self.moving {
            say(format_args!(
                "  moving from a chance of 0.5: recall {}, precision {}, calibration error {:.3}",
                share(moving.recall),
                share(moving.precision),
                moving.calibration_error
            ))?;
        }
        self.print_buckets()
    }

    /// Prints the bucket-normalized errors by class and speed, where points have classes.
    pub(super) fn print_buckets(&self) -> Result<(), Failure> {
        self.bucket_normalized
            .as_ref()
            .map_or(Ok(()), BucketNormalizedReport::print)
    }

    /// Prints the scores as one row of a table.
    pub(super) fn print_row(&self, name: &str, width: usize) -> Result<(), Failure> {
        let value = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.4}"));
        let three_way = self.three_way.as_ref().and_then(|three_way| three_way.epe);
        let buckets = self.bucket_normalized.as_ref();
        say(format_args!(
            "{name:width$}  {:>10}  {:>7.4}  {:>7}  {:>7}  {:>6.4}  {:>6.4}  {:>9}  {:>9}  {:>11}",
            grouped(self.points),
            self.epe,
            value(self.epe_dynamic),
            value(self.epe_static),
            self.acc5,
            self.acc10,
            value(three_way),
            value(buckets.and_then(|buckets| buckets.dynamic_error)),
            value(self.confidence.as_ref().map(|of| of.calibration_error)),
        ))
    }

    /// Prints the heading of the table, above [`Self::print_row`].
    pub(super) fn print_heading(width: usize) -> Result<(), Failure> {
        say(format_args!(
            "{:width$}  {:>10}  {:>7}  {:>7}  {:>7}  {:>6}  {:>6}  {:>9}  {:>9}  {:>11}",
            "flow",
            "points",
            "EPE",
            "moving",
            "static",
            "Acc5",
            "Acc10",
            "three-way",
            "bucket-n.",
            "calibration"
        ))
    }
}
