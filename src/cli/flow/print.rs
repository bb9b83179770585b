//! The report of a pair as text.

use crate::cli::failure::Failure;
use crate::cli::output::{complain, show};
use crate::job::Report;
use crate::text::grouped;

/// Prints a report as text.
pub(in crate::cli) fn print_report(report: &Report) -> Result<(), Failure> {
    let seconds = &report.seconds;
    show(format_args!(
        "flow of {} points in {:.2} s on {}",
        grouped(report.valid_points),
        seconds.total,
        report.device
    ))?;
    let phases = [
        ("load", seconds.load),
        ("precompute", Some(seconds.precompute)),
        ("search", seconds.search),
        ("query", seconds.query),
        ("network", seconds.network),
    ];
    let phases = phases.into_iter();
    let phases = phases.filter_map(|(name, taken)| Some(format!("{name} {:.2} s", taken?)));
    show(format_args!("  {}", phases.collect::<Vec<_>>().join(", ")))?;
    let (preset, reason) = (&report.preset, &report.stop_reason);
    if let Some(objects) = &report.objects {
        let cost = objects.cost_m.map(|cost| format!(", cost {cost:.4} m"));
        let (clusters, moving, cost) = (objects.searched, objects.moving, cost.unwrap_or_default());
        show(format_args!(
            "  preset {preset}: {clusters} clusters, {moving} move ({reason}){cost}"
        ))?;
        if objects.own_points > 0 {
            show(format_args!(
                "  {} points of the vehicle itself have no flow",
                grouped(objects.own_points)
            ))?;
        }
    }
    if let Some(field) = &report.field {
        let unit = &field.loss_unit;
        let loss = field
            .best_loss
            .map(|loss| format!(", loss {loss:.4} {unit}"));
        let (seed, iterations, loss) = (report.seed, field.iterations, loss.unwrap_or_default());
        show(format_args!(
            "  preset {preset}, seed {seed}: {iterations} iterations ({reason}){loss}"
        ))?;
    }
    if let Some(motion) = report.ego_motion {
        let [x, y, z] = [motion[0][3], motion[1][3], motion[2][3]];
        show(format_args!(
            "  ego motion {x:.3}, {y:.3}, {z:.3} m (target from source)"
        ))?;
    }
    if let Some(covariance) = &report.ego_covariance {
        let deviation: [f64; 6] = core::array::from_fn(|a| covariance[a][a].max(0.0).sqrt());
        let [x, y, z] = [0, 1, 2].map(|a| 1e3 * deviation[a]);
        let [roll, pitch, yaw] = [3, 4, 5].map(|a| deviation[a].to_degrees());
        show(format_args!(
            "    certain to {x:.1}, {y:.1}, {z:.1} mm; roll, pitch, yaw to {roll:.3}, {pitch:.3}, {yaw:.3} degrees"
        ))?;
    }
    if let Some(deskew) = report.deskew {
        let [given, deskewed] = deskew.distance_m.map(|m| 100.0 * m);
        let outcome = match deskew.applied {
            true => "deskewed",
            false => "taken as they are",
        };
        show(format_args!(
            "  sweeps {outcome}: near points {given:.2} cm from the target as given, {deskewed:.2} cm deskewed"
        ))?;
    }
    for warning in &report.warnings {
        complain(format_args!("warning: {warning}"));
    }
    if let Some(overlap) = report.overlap {
        show(format_args!(
            "  overlap {:.0}% of the source",
            100.0 * overlap
        ))?;
    }
    Ok(())
}
