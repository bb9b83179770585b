//! The bucket-normalized errors by class and speed, as Argoverse 2's second benchmark has them.

use serde::Serialize;

use crate::cli::failure::Failure;
use crate::cli::output::say;
use crate::flow::evaluate::{Bucket, BucketReport, CLASSES, ClassError};

/// Lower bounds of the ranges of speed, metres a sweep interval: the bounds of buckets. The first is
/// that of the slowest moving bucket, and the last range has no upper bound.
const SPEEDS_M: [f64; 5] = [0.04, 0.2, 0.52, 1.0, 2.0];

/// Bucket-normalized errors, as `--json` prints them.
#[derive(Debug, Serialize)]
pub(super) struct BucketNormalizedReport {
    pub(super) dynamic_error: Option<f64>,
    static_epe: Option<f64>,
    classes: Vec<ClassReport>,
}

#[derive(Debug, Serialize)]
struct ClassReport {
    class: &'static str,
    dynamic_error: Option<f64>,
    static_epe: Option<f64>,
    points: usize,
    speeds: Vec<SpeedReport>,
}

/// The dynamic error of a range of speed: the mean over its buckets.
#[derive(Debug, Serialize)]
struct SpeedReport {
    /// Lower bound of the true speed, metres a sweep interval.
    from: f64,
    dynamic_error: Option<f64>,
    points: usize,
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

    /// Prints a table: a row for each class, and one for their mean.
    pub(super) fn print(&self) -> Result<(), Failure> {
        let value = |value: Option<f64>, digits| {
            value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
        };
        say(format_args!(
            "  bucket-normalized, within 35 m: error over speed, 1 is no motion at all; speeds in m a sweep"
        ))?;
        let bounds = SPEEDS_M.iter().skip(1).map(|end| format!("{end}"));
        let ranges = SPEEDS_M.iter().zip(bounds.chain([String::new()]));
        let heading: String = ranges
            .map(|(from, end)| format!("{:>10}", format!("{from}-{end}")))
            .collect();
        say(format_args!(
            "    {:<22}{:>10}{:>9}{heading}",
            "class", "static (m)", "moving"
        ))?;
        for of in &self.classes {
            let speeds = of.speeds.iter();
            let speeds: String = speeds
                .map(|speed| format!("{:>10}", value(speed.dynamic_error, 3)))
                .collect();
            let (still, moving) = (value(of.static_epe, 4), value(of.dynamic_error, 3));
            say(format_args!(
                "    {:<22}{still:>10}{moving:>9}{speeds}",
                of.class
            ))?;
        }
        let (still, moving) = (value(self.static_epe, 4), value(self.dynamic_error, 3));
        say(format_args!("    {:<22}{still:>10}{moving:>9}", "mean"))
    }
}
