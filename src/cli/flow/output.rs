//! What `fnsf flow` writes and prints of a pair.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::Serialize;

use super::arguments::{Flow, numbered};
use super::print::print_report;
use crate::cli::failure::Failure;
use crate::cli::files;
use crate::cli::output::{show, without_reader};
use crate::flow::{Estimate, Point};
use crate::formats::{FlowFormat, FlowTable, write_flow};
use crate::job::Report;
use crate::picture;
use crate::picture::{TopDown, TopDownOptions};

/// A sweep of a folder that is followed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    /// When its last byte was written.
    pub(super) written: SystemTime,
    /// When its flow is due, seconds of the terminal's clock.
    pub(super) due_s: Option<f64>,
    /// Number of later sweeps that waited when it was read.
    pub(super) waiting: usize,
}

impl Arrival {
    /// Seconds since its last byte was written.
    pub(super) fn age_s(&self) -> f64 {
        self.written.elapsed().map_or(0.0, |age| age.as_secs_f64())
    }
}

/// What a pair is reported with.
pub(super) struct Complete<'a> {
    pub(super) estimate: &'a Estimate,
    pub(super) report: Report,
    pub(super) source: &'a [Point],
    /// Number of the pair, and the number of pairs.
    pub(super) number: [usize; 2],
    /// The names of its sweeps.
    pub(super) names: &'a [String; 2],
    pub(super) arrived: Option<Arrival>,
}

/// Writes, draws and prints a pair. Returns the seconds since its target was written, in a folder
/// that is followed.
pub(super) fn put(flow: &Flow, pair: &Complete<'_>) -> Result<Option<f64>, Failure> {
    let Complete {
        estimate, source, ..
    } = *pair;
    let index = |path: &PathBuf| numbered(path, pair.number[0], pair.number[1]);
    let (output, picture) = (
        flow.output.as_ref().map(index),
        flow.picture.as_ref().map(index),
    );
    if let Some(path) = &output {
        write(estimate, source, path)?;
    }
    if let Some(path) = &picture {
        draw(estimate, source, path)?;
    }
    let latency_s = pair.arrived.map(|arrived| arrived.age_s());
    let said = tell_of(flow, pair, latency_s, output.iter().chain(&picture));
    match flow.writes() {
        true => without_reader(said)?,
        false => said?,
    }
    Ok(latency_s)
}

/// Prints a pair, with the files that were written.
fn tell_of<'a>(
    flow: &Flow,
    pair: &Complete<'_>,
    latency_s: Option<f64>,
    written: impl Iterator<Item = &'a PathBuf>,
) -> Result<(), Failure> {
    if flow.json {
        let json = match pair.arrived.zip(latency_s) {
            None => serde_json::to_string(&pair.report),
            Some((arrived, latency_s)) => serde_json::to_string(&FollowedReport {
                report: &pair.report,
                sweeps: pair.names,
                latency_s,
                waiting: arrived.waiting,
            }),
        };
        return show(format_args!("{}", json.map_err(Failure::internal)?));
    }
    print_report(&pair.report)?;
    if let Some((arrived, latency_s)) = pair.arrived.zip(latency_s) {
        let [source, target] = pair.names;
        let waiting = match arrived.waiting {
            0 => String::new(),
            count => format!(", {count} sweeps wait"),
        };
        show(format_args!(
            "  {source} to {target}: {:.0} ms after its last byte{waiting}",
            latency_s * 1e3
        ))?;
    }
    for path in written {
        show(format_args!("  wrote {}", path.display()))?;
    }
    Ok(())
}

/// The report of a pair in a folder that is followed.
#[derive(Serialize)]
struct FollowedReport<'a> {
    #[serde(flatten)]
    report: &'a Report,
    /// The names of the source and of the target.
    sweeps: &'a [String; 2],
    /// Seconds from the last byte of the target to the written flow.
    latency_s: f64,
    /// Sweeps that waited when the target was read.
    waiting: usize,
}

/// Writes the flow in the format given by the path's ending.
fn write(estimate: &Estimate, source: &[Point], path: &Path) -> Result<(), Failure> {
    let format = FlowFormat::from_path(path).map_err(Failure::usage)?;
    let table = FlowTable::new(source, estimate);
    files::write(path, |file| write_flow(format, &table, file))
}

/// Draws the flow from above.
fn draw(estimate: &Estimate, source: &[Point], path: &Path) -> Result<(), Failure> {
    let image = picture::top_down(
        &TopDown {
            source,
            flow: &estimate.flow,
            valid: &estimate.valid,
            ego: estimate.ego.as_ref(),
            clusters: estimate
                .objects()
                .map_or(&[], |objects| objects.clusters.as_slice()),
        },
        &TopDownOptions::default(),
    );
    files::write(path, |file| picture::write_png(&image, file))
}
