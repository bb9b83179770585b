//! Scores of flows, as JSON.

use serde::Serialize;

use super::buckets::BucketNormalizedReport;
use crate::flow::evaluate::{Calibration, Part, ThreeWay};

/// The scores: errors in metres, angles in radians, shares from 0 to 1.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Name of the flow where it is one of several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flow: Option<String>,
    /// Number of scored points.
    pub points: usize,
    /// Mean end-point error (EPE), metres.
    pub epe: f64,
    /// Share of points with an error under 0.05 m or 5 %.
    pub acc5: f64,
    /// Share of points with an error under 0.1 m or 10 %.
    pub acc10: f64,
    /// Share of points with an error over 0.3 m or 10 %.
    pub outliers: f64,
    /// Mean angle between estimated and true flow, radians.
    pub angle_error: f64,
    /// EPE of moving points, metres; none where they are not known.
    pub epe_dynamic: Option<f64>,
    /// EPE of static points, metres; none where they are not known.
    pub epe_static: Option<f64>,
    /// Three-way EPE within 35 m of the sensor.
    pub three_way: Option<ThreeWayReport>,
    /// Metrics of the Argoverse 2 scene flow task.
    pub argoverse2: Argoverse2Report,
    /// Bucket-normalized errors by class and speed.
    pub bucket_normalized: Option<BucketNormalizedReport>,
    /// Calibration of the confidence; none where the flow has none.
    pub confidence: Option<ConfidenceReport>,
    /// Calibration of the probability of motion; none where the flow has none.
    pub moving: Option<MovingReport>,
}

/// A three-way EPE.
#[derive(Debug, Serialize)]
pub struct ThreeWayReport {
    /// Mean of the three errors, metres.
    pub epe: Option<f64>,
    /// EPE of moving points on objects, metres.
    pub foreground_dynamic: Option<f64>,
    /// EPE of static points on objects, metres.
    pub foreground_static: Option<f64>,
    /// EPE of static points on no object, metres.
    pub background_static: Option<f64>,
    /// Numbers of points of the three parts.
    pub points: [usize; 3],
}

/// Metrics of the Argoverse 2 scene flow task.
#[derive(Debug, Serialize)]
pub struct Argoverse2Report {
    /// Share of points with an error under 0.05 m or 5 %.
    pub accuracy_strict: f64,
    /// Share of points with an error under 0.1 m or 10 %.
    pub accuracy_relax: f64,
    /// Mean angle in space and time, radians.
    pub angle_error: f64,
    /// Intersection over union of the moving points.
    pub dynamic_iou: Option<f64>,
    /// Three-way EPE at all ranges.
    pub three_way: Option<ThreeWayReport>,
}

/// How well the confidence tells right flows from others.
#[derive(Debug, Serialize)]
pub struct ConfidenceReport {
    /// Mean distance of the confidence from the share of right flows.
    pub calibration_error: f64,
    /// EPE of the half with the higher confidence, metres.
    pub sure_half_epe: f64,
    /// EPE of the other half, metres.
    pub rest_epe: f64,
}

/// The probability that a point moves. Recall and precision are of the points with 0.5 or more; null where
/// none moves, or none has that.
#[derive(Debug, Serialize)]
pub struct MovingReport {
    /// Mean distance of the probability from the share of moving points.
    pub calibration_error: f64,
    /// Share of the moving points that have 0.5 or more.
    pub recall: Option<f64>,
    /// Share of the points with 0.5 or more that move.
    pub precision: Option<f64>,
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
