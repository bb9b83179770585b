//! Scores of tracks, as text or JSON.

use std::path::PathBuf;

use serde::Serialize;

use crate::cli::failure::Failure;
use crate::cli::files;
use crate::cli::output::say;
use crate::flow::evaluate::{TrackingMetrics, TrackingPool, tracked_sweeps};
use crate::text::grouped;

/// The score of one file of tracks, or of several together.
#[derive(Serialize)]
struct Report {
    /// The file; missing for all together.
    #[serde(skip_serializing_if = "Option::is_none")]
    tracks: Option<String>,
    /// True objects, summed over sweeps.
    truth: usize,
    /// Found objects, summed over sweeps.
    found: usize,
    matches: usize,
    switches: usize,
    distance_m: f64,
    mota: f64,
    idf1: f64,
    hota: f64,
}

impl Report {
    fn new(tracks: Option<String>, metrics: &TrackingMetrics) -> Self {
        let TrackingMetrics {
            truth,
            found,
            matches,
            switches,
            distance_m,
            mota,
            idf1,
            hota,
        } = *metrics;
        Self {
            tracks,
            truth,
            found,
            matches,
            switches,
            distance_m,
            mota,
            idf1,
            hota,
        }
    }

    fn print(&self) -> Result<(), Failure> {
        let percent = |whole: usize| 100.0 * self.matches as f64 / whole.max(1) as f64;
        if let Some(name) = &self.tracks {
            say(format_args!("{name}"))?;
        }
        say(format_args!(
            "  objects x sweeps  {}, {:.1}% found",
            grouped(self.truth),
            percent(self.truth)
        ))?;
        say(format_args!(
            "  found             {}, {:.1}% right",
            grouped(self.found),
            percent(self.found)
        ))?;
        say(format_args!("  identity switches {}", self.switches))?;
        say(format_args!("  distance          {:.2} m", self.distance_m))?;
        say(format_args!("  MOTA              {:.3}", self.mota))?;
        say(format_args!("  IDF1              {:.3}", self.idf1))?;
        say(format_args!("  HOTA              {:.3}", self.hota))
    }
}

/// Compares each file of `found` tracks with its `truth`, and all together.
pub(super) fn run(found: &[PathBuf], truth: &[PathBuf], json: bool) -> Result<(), Failure> {
    let put = |report: &Report| {
        if json {
            let json = serde_json::to_string(report).map_err(Failure::internal)?;
            say(format_args!("{json}"))
        } else {
            report.print()
        }
    };
    let mut all = TrackingPool::default();
    for (path, truth) in found.iter().zip(truth) {
        let sweeps = tracked_sweeps(&files::read_tracks(truth)?, &files::read_tracks(path)?);
        let mut one = TrackingPool::default();
        for pool in [&mut one, &mut all] {
            pool.add(&sweeps);
        }
        let name = path.display().to_string();
        put(&Report::new(Some(name), &one.metrics()))?;
    }
    if found.len() > 1 {
        if !json {
            say(format_args!("all"))?;
        }
        put(&Report::new(None, &all.metrics()))?;
    }
    Ok(())
}
