//! Reports: what became of each pair, as lines of JSON.

use serde::{Deserialize, Serialize};

use crate::flow::Estimate;
use crate::job::warnings;

/// What became of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// Its output was written.
    Labelled,
    /// Another process wrote its output meanwhile.
    Raced,
    /// Its sweeps cannot be used.
    Refused,
    /// A store failed; trying again may help.
    Failed,
}

impl Outcome {
    /// Of what did not succeed, by whether trying again may help.
    pub(super) fn of_trouble(may_pass: bool) -> Self {
        match may_pass {
            true => Self::Failed,
            false => Self::Refused,
        }
    }
}

/// The report of a pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RowReport {
    /// The name of its output.
    pub key: String,
    /// The earlier sweep.
    pub source: String,
    /// The later sweep.
    pub target: String,
    /// What became of it.
    pub outcome: Outcome,
    /// Why it was refused or failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// Seconds of the estimate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Number of source points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub points: Option<usize>,
    /// Number of moving objects, or none for the fit of a field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moving: Option<usize>,
    /// Share of the scene that both sweeps show, 0 to 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub overlap: Option<f32>,
    /// Whether its flow starts from deskewed points, where they have times.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deskewed: Option<bool>,
    /// Whether it is of the tracks of a drive, and not of a pair.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub tracks: bool,
    /// Whether its output was there before.
    #[serde(skip)]
    pub was_there: bool,
    /// Sweeps around the pair that could not be read, and were left out.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<String>,
    /// What is suspicious about its sweeps, in words.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}

impl RowReport {
    /// The report of a pair before anything is known.
    pub(super) fn new(key: String, source: &str, target: &str) -> Self {
        Self {
            key,
            source: source.to_owned(),
            target: target.to_owned(),
            outcome: Outcome::Failed,
            error: None,
            seconds: None,
            points: None,
            moving: None,
            overlap: None,
            deskewed: None,
            tracks: false,
            was_there: false,
            left_out: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// With the figures of its estimate.
    pub(super) fn with(mut self, estimate: &Estimate) -> Self {
        self.seconds = Some(estimate.total_seconds);
        self.points = Some(estimate.flow.len());
        let objects = estimate.objects();
        self.moving = objects.map(|of| of.clusters.iter().filter(|one| one.dynamic).count());
        self.overlap = estimate.overlap;
        self.warnings.extend(warnings(estimate));
        let deskew = estimate.deskew.as_ref();
        self.deskewed = deskew.map(|deskew| deskew.points.is_some());
        self
    }

    /// With an end that is no success.
    pub(super) fn ended(mut self, outcome: Outcome, error: &impl ToString) -> Self {
        self.outcome = outcome;
        self.error = Some(error.to_string());
        self
    }

    /// Whether the output is there.
    pub fn is_there(&self) -> bool {
        matches!(self.outcome, Outcome::Labelled | Outcome::Raced)
    }
}

/// Reports as lines of JSON.
pub(super) fn lines(reports: &[RowReport]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for report in reports {
        serde_json::to_writer(&mut bytes, report).expect("a report has a JSON form");
        bytes.push(b'\n');
    }
    bytes
}

/// Reads what [`lines`] writes. Lines that are none are left out: a report is no reason to fail.
pub(super) fn read_lines(bytes: &[u8]) -> Vec<RowReport> {
    let lines = bytes.split(|&byte| byte == b'\n');
    lines
        .filter_map(|line| serde_json::from_slice(line).ok())
        .collect()
}
