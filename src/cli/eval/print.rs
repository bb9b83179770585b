//! Prints scores as text.

use crate::cli::failure::Failure;
use crate::cli::output::show;
use crate::scores::{BucketNormalizedReport, Report, SPEEDS_M};
use crate::text::grouped;

/// Prints the scores as text.
pub(super) fn print(report: &Report) -> Result<(), Failure> {
    let metres = |value: Option<f64>| value.map_or("-".to_owned(), |m| format!("{m:.4} m"));
    let share = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.3}"));
    show(format_args!("{} points scored", grouped(report.points)))?;
    show(format_args!("  EPE          {:.4} m", report.epe))?;
    show(format_args!(
        "    moving     {}",
        metres(report.epe_dynamic)
    ))?;
    show(format_args!("    static     {}", metres(report.epe_static)))?;
    show(format_args!(
        "  Acc5, Acc10  {:.4}, {:.4}",
        report.acc5, report.acc10
    ))?;
    show(format_args!("  outliers     {:.4}", report.outliers))?;
    show(format_args!("  angle        {:.4} rad", report.angle_error))?;
    if let Some(three_way) = &report.three_way {
        show(format_args!(
            "  three-way    {} (within 35 m)",
            metres(three_way.epe)
        ))?;
    }
    if let Some(iou) = report.argoverse2.dynamic_iou {
        show(format_args!("  moving IoU   {iou:.4}"))?;
    }
    if let Some(confidence) = &report.confidence {
        show(format_args!(
            "  confidence   surer half {:.4} m, rest {:.4} m, calibration error {:.3}",
            confidence.sure_half_epe, confidence.rest_epe, confidence.calibration_error
        ))?;
    }
    if let Some(moving) = &report.moving {
        show(format_args!(
            "  moving from a probability of 0.5: recall {}, precision {}, calibration error {:.3}",
            share(moving.recall),
            share(moving.precision),
            moving.calibration_error
        ))?;
    }
    print_buckets(report)
}

/// Prints the bucket-normalized errors by class and speed, where points have classes.
pub(super) fn print_buckets(report: &Report) -> Result<(), Failure> {
    report
        .bucket_normalized
        .as_ref()
        .map_or(Ok(()), print_table)
}

/// Prints the scores as one row of a table.
pub(super) fn print_row(report: &Report, name: &str, width: usize) -> Result<(), Failure> {
    let value = |value: Option<f64>| value.map_or("-".to_owned(), |v| format!("{v:.4}"));
    let three_way = report
        .three_way
        .as_ref()
        .and_then(|three_way| three_way.epe);
    let buckets = report.bucket_normalized.as_ref();
    show(format_args!(
        "{name:width$}  {:>10}  {:>7.4}  {:>7}  {:>7}  {:>6.4}  {:>6.4}  {:>9}  {:>9}  {:>11}",
        grouped(report.points),
        report.epe,
        value(report.epe_dynamic),
        value(report.epe_static),
        report.acc5,
        report.acc10,
        value(three_way),
        value(buckets.and_then(|buckets| buckets.dynamic_error)),
        value(report.confidence.as_ref().map(|of| of.calibration_error)),
    ))
}

/// Prints the heading of the table, above [`print_row`].
pub(super) fn print_heading(width: usize) -> Result<(), Failure> {
    show(format_args!(
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

/// Prints a table: a row for each class, and one for their mean.
fn print_table(buckets: &BucketNormalizedReport) -> Result<(), Failure> {
    let value = |value: Option<f64>, digits| {
        value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
    };
    show(format_args!(
        "  bucket-normalized, within 35 m: error over speed, 1 is no motion at all; speeds in m a sweep"
    ))?;
    let bounds = SPEEDS_M.iter().skip(1).map(|end| format!("{end}"));
    let ranges = SPEEDS_M.iter().zip(bounds.chain([String::new()]));
    let heading: String = ranges
        .map(|(from, end)| format!("{:>10}", format!("{from}-{end}")))
        .collect();
    show(format_args!(
        "    {:<22}{:>10}{:>9}{heading}",
        "class", "static (m)", "moving"
    ))?;
    for of in &buckets.classes {
        let speeds = of.speeds.iter();
        let speeds: String = speeds
            .map(|speed| format!("{:>10}", value(speed.dynamic_error, 3)))
            .collect();
        let (still, moving) = (value(of.static_epe, 4), value(of.dynamic_error, 3));
        show(format_args!(
            "    {:<22}{still:>10}{moving:>9}{speeds}",
            of.class
        ))?;
    }
    let (still, moving) = (
        value(buckets.static_epe, 4),
        value(buckets.dynamic_error, 3),
    );
    show(format_args!("    {:<22}{still:>10}{moving:>9}", "mean"))
}
