//! Scores of tracks, as text or JSON.

use std::path::PathBuf;

use crate::cli::failure::Failure;
use crate::cli::files;
use crate::cli::output::show;
use crate::flow::evaluate::{TrackingMetrics, TrackingPool, tracked_sweeps};
use crate::text::grouped;

/// Prints a score as one JSON object. It is of the file `name`, or of all together.
fn print_json(name: Option<&str>, metrics: &TrackingMetrics) -> Result<(), Failure> {
    let mut json = serde_json::json!({
        "truth": metrics.truth,
        "found": metrics.found,
        "matches": metrics.matches,
        "switches": metrics.switches,
        "distance_m": metrics.distance_m,
        "mota": metrics.mota,
        "idf1": metrics.idf1,
        "hota": metrics.hota,
    });
    if let Some(name) = name {
        json["tracks"] = name.into();
    }
    show(format_args!("{json}"))
}

/// Prints a score as text. It is of the file `name`, or of all together.
fn print_text(name: Option<&str>, metrics: &TrackingMetrics) -> Result<(), Failure> {
    let percent = |whole: usize| 100.0 * metrics.matches as f64 / whole.max(1) as f64;
    let [truth, found] = [metrics.truth, metrics.found];
    show(format_args!("{}", name.unwrap_or("all")))?;
    show(format_args!(
        "  true boxes        {}, recall {:.1}%",
        grouped(truth),
        percent(truth)
    ))?;
    show(format_args!(
        "  found boxes       {}, precision {:.1}%",
        grouped(found),
        percent(found)
    ))?;
    show(format_args!("  identity switches {}", metrics.switches))?;
    show(format_args!(
        "  distance          {:.2} m",
        metrics.distance_m
    ))?;
    show(format_args!("  MOTA              {:.3}", metrics.mota))?;
    show(format_args!("  IDF1              {:.3}", metrics.idf1))?;
    show(format_args!("  HOTA              {:.3}", metrics.hota))
}

/// Compares each file of `found` tracks with its `truth`, and all together.
pub(super) fn run(found: &[PathBuf], truth: &[PathBuf], json: bool) -> Result<(), Failure> {
    let print = if json { print_json } else { print_text };
    let mut all = TrackingPool::default();
    for (path, truth) in found.iter().zip(truth) {
        let sweeps = tracked_sweeps(&files::read_tracks(truth)?, &files::read_tracks(path)?);
        let mut one = TrackingPool::default();
        for pool in [&mut one, &mut all] {
            pool.add(&sweeps);
        }
        print(Some(&path.display().to_string()), &one.metrics())?;
    }
    if found.len() > 1 {
        print(None, &all.metrics())?;
    }
    Ok(())
}
