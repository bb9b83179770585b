//! The ablation of the distance transform's cells.

use std::fmt;

use serde::Serialize;

use super::devices::Devices;
use super::measure::{Budget, Subject, measure};
use crate::cli::failure::Failure;
use crate::cli::output::tell;
use crate::cli::terminal::Terminal;
use crate::flow::Options;
use crate::job::{FieldChoices, JobOptions, PresetChoice};

/// The edges of FNSF's ablation, metres.
const EDGES_M: [f64; 8] = [1.0, 0.5, 0.33, 0.2, 0.1, 0.05, 0.02, 0.01];

/// One cell size on one pair.
#[derive(Clone, Debug, Serialize)]
pub(super) struct CellFigures {
    pub(super) pair: String,
    pub(super) cell_m: f64,
    /// Why there are no figures; none if there are.
    pub(super) refused: Option<String>,
    /// The figures; none if the size was refused.
    #[serde(flatten)]
    pub(super) measured: Option<Measured>,
}

/// The figures of one cell size.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Measured {
    /// The device that it ran on.
    pub(super) device: String,
    /// Mean end-point error, metres.
    pub(super) epe: f64,
    pub(super) total_seconds: f64,
    pub(super) precompute_seconds: f64,
    /// Bytes of the distance transform.
    pub(super) transform_bytes: usize,
}

/// What the ablation runs with.
pub(super) struct Ablation<'a> {
    pub(super) devices: &'a Devices,
    pub(super) bev: bool,
    pub(super) budget: Option<f64>,
    /// Adds what the pair and the command line decide.
    pub(super) complete: &'a dyn Fn(&JobOptions) -> Options,
    pub(super) terminal: &'a Terminal,
    /// Whether the tables are written to files too.
    pub(super) writes: bool,
}

impl Ablation<'_> {
    /// Measures and prints all cell sizes on one pair. A size that does not fit in memory has the
    /// refusal as its row.
    pub(super) fn run(&self, subject: &Subject) -> Result<Vec<CellFigures>, Failure> {
        let name = &subject.name;
        let mode = if self.bev { ", bird's eye view" } else { "" };
        self.terminal.finish();
        let say = |line: fmt::Arguments<'_>| tell(self.writes, line);
        say(format_args!(
            "\nCells of the distance transform, fnsf{mode}\n"
        ))?;
        say(format_args!(
            "| cell, m | E, m | pre-compute, s | total, s | transform, MB |\n|---|---|---|---|---|"
        ))?;
        let mut all = Vec::new();
        for cell_m in EDGES_M {
            self.terminal.part(&format!("{name}, cells of {cell_m} m"));
            let options = (self.complete)(&JobOptions {
                preset: PresetChoice::Paper,
                field: FieldChoices {
                    cell_m: Some(cell_m),
                    bev: self.bev,
                    ..FieldChoices::default()
                },
                ..JobOptions::default()
            });
            let control = Budget::new(self.budget, self.terminal);
            let (refused, measured) = match measure(self.devices, subject, &options, &control) {
                Ok(run) => {
                    let measured = Measured {
                        device: run.device,
                        epe: run.metrics.epe,
                        total_seconds: run.total,
                        precompute_seconds: run.precompute,
                        transform_bytes: run.target_bytes.unwrap_or(0),
                    };
                    (None, Some(measured))
                }
                Err(error) if error.is_input() => (Some(error.to_string()), None),
                Err(error) => return Err(Failure::internal(error)),
            };
            self.terminal.finish();
            match &measured {
                None => say(format_args!(
                    "| {cell_m} | {} | | | |",
                    refused.as_deref().unwrap_or_default()
                ))?,
                Some(figures) => say(format_args!(
                    "| {cell_m} | {:.4} | {:.3} | {:.2} | {:.1} |",
                    figures.epe,
                    figures.precompute_seconds,
                    figures.total_seconds,
                    figures.transform_bytes as f64 / 1e6
                ))?,
            }
            all.push(CellFigures {
                pair: name.clone(),
                cell_m,
                refused,
                measured,
            });
        }
        Ok(all)
    }
}
