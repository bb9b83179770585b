//! The bucket-normalized errors by class and speed, as Argoverse 2's second benchmark has them.

use serde::Serialize;

use crate::flow::evaluate::{Bucket, BucketReport, CLASSES, ClassError};

/// Lower bounds of the ranges of speed, metres a sweep interval: the bounds of buckets. The first is
/// that of the slowest moving bucket, and the last range has no upper bound.
pub const SPEEDS_M: [f64; 5] = [0.04, 0.2, 0.52, 1.0, 2.0];

/// Bucket-normalized errors: ratios of error to speed, and errors of static points in metres.
#[derive(Debug, Serialize)]
pub struct BucketNormalizedReport {
    /// Mean over the classes; none where none moves.
    pub dynamic_error: Option<f64>,
    /// Mean over the classes, metres.
    pub static_epe: Option<f64>,
    /// The classes that have points.
    pub classes: Vec<ClassReport>,
}

/// Errors of a class.
#[derive(Debug, Serialize)]
pub struct ClassReport {
    /// Name of the class.
    pub class: &'static str,
    /// Mean over the buckets of speed.
    pub dynamic_error: Option<f64>,
    /// EPE of static points, metres.
    pub static_epe: Option<f64>,
    /// Number of points.
    pub points: usize,
    /// The errors by ranges of speed, see [`SPEEDS_M`].
    pub speeds: Vec<SpeedReport>,
}

/// The dynamic error of a range of speed: the mean over its buckets.
#[derive(Debug, Serialize)]
pub struct SpeedReport {
    /// Lower bound of the true speed, metres a sweep interval.
    pub from: f64,
    /// Mean over the buckets.
    pub dynamic_error: Option<f64>,
    /// Number of points.
    pub points: usize,
}

impl SpeedReport {
    fn new(buckets: &[Bucket], range: usize) -> Self {
        let from = SPEEDS_M[range];
        let end = SPEEDS_M.get(range + 1).copied().unwrap_or(f64::INFINITY);
        // A bucket's bound is a multiple of its width, and rounded.
        let middle = |bucket: &Bucket| bucket.from + 0.02;
        let within = buckets.iter().filter(|b| (from..end).contains(&middle(b)));
        let ratios: Vec<f64> = within
            .clone()
            .map(|bucket| bucket.epe / bucket.speed)
            .collect();
        let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
        Self {
            from,
            dynamic_error: (!ratios.is_empty()).then_some(mean),
            points: within.map(|bucket| bucket.points).sum(),
        }
    }
}

impl ClassReport {
    fn new(class: &'static str, error: &ClassError) -> Self {
        let speeds = 0..SPEEDS_M.len();
        Self {
            class,
            dynamic_error: error.dynamic_error,
            static_epe: error.static_epe,
            points: error.buckets.iter().map(|bucket| bucket.points).sum(),
            speeds: speeds
                .map(|range| SpeedReport::new(&error.buckets, range))
                .collect(),
        }
    }
}

impl BucketNormalizedReport {
    /// `None` where no point has a class.
    pub(super) fn new(report: &BucketReport) -> Option<Self> {
        let classes = CLASSES.iter().zip(&report.classes);
        let classes: Vec<ClassReport> = classes
            .filter(|(_, error)| !error.buckets.is_empty())
            .map(|(class, error)| ClassReport::new(class, error))
            .collect();
        (!classes.is_empty()).then_some(Self {
            dynamic_error: report.dynamic_error,
            static_epe: report.static_epe,
            classes,
        })
    }
}
