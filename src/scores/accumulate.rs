//! Accumulates the scores of flows.

use super::buckets::BucketNormalizedReport;
use super::report::{Argoverse2Report, ConfidenceReport, MovingReport, Report, ThreeWayReport};
use crate::flow::evaluate::{
    Argoverse2Pool, BucketNormalized, CLASSES, EvaluateError, Pool, Reliability, Truth,
    class_of_category, class_of_foreground,
};
use crate::formats::{FlowFile, Pair, PairTruth};

/// The truth of a pair, with the masks, the source and the ego motion that are known.
pub fn truth_of<'a>(known: &'a PairTruth, pair: &'a Pair) -> Truth<'a> {
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
#[derive(Debug)]
pub struct Scores {
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
    ///
    /// # Errors
    /// [`EvaluateError::Length`] where the arrays differ in length.
    pub fn add(
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
    ///
    /// # Errors
    /// [`EvaluateError::NoPoints`] if no row could be scored.
    pub fn report(&self, flow: Option<String>) -> Result<Report, EvaluateError> {
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
