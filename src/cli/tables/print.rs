//! The table as Markdown and as CSV.

use std::fmt::Write as _;
use std::io::{self, Write};

use super::figures::Figures;
use crate::cli::failure::Failure;
use crate::cli::output::tell;

/// A number with `digits` digits after the point, or a dash.
fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
}

const HEADING: [&str; 17] = [
    "method",
    "E, m",
    "of seeds",
    "Acc5",
    "Acc10",
    "angle, rad",
    "E moving, m",
    "pre-compute, s",
    "query, ms a step",
    "query, s",
    "network, ms a step",
    "network, s",
    "total, s",
    "iterations",
    "memory, MB",
    "paper: E, Acc5",
    "paper: total, s",
];

/// Prints one row of the table.
fn cells(figures: &Figures) -> [String; 17] {
    let [epe, low, high] = figures.epe;
    let cut = if figures.cut { " (cut)" } else { "" };
    let paper = match (figures.paper_epe, figures.paper_acc5) {
        (None, None) => "-".to_owned(),
        (epe, acc5) => format!("{}, {}", number(epe, 3), number(acc5, 3)),
    };
    [
        figures.method.to_owned(),
        number(Some(epe), 4),
        format!("{low:.4} to {high:.4} ({})", figures.seeds),
        number(Some(figures.acc5), 3),
        number(Some(figures.acc10), 3),
        number(Some(figures.angle), 3),
        number(figures.epe_dynamic, 3),
        number(Some(figures.precompute_seconds), 3),
        number(figures.step_ms(figures.query_seconds), 2),
        number(Some(figures.query_seconds), 2),
        number(figures.step_ms(figures.network_seconds), 2),
        number(Some(figures.network_seconds), 2),
        format!("{}{cut}", number(Some(figures.total_seconds), 2)),
        figures
            .iterations
            .map_or_else(|| "-".to_owned(), |count| count.to_string()),
        number(Some(figures.bytes as f64 / 1e6), 0),
        paper,
        number(figures.paper_total_seconds, 2),
    ]
}

/// Prints the heading of a table; see [`tell`].
pub(super) fn heading(writes: bool) -> Result<(), Failure> {
    tell(writes, format_args!("| {} |", HEADING.join(" | ")))?;
    let mut line = String::from("|");
    for _ in HEADING {
        let _ = write!(line, "---|");
    }
    tell(writes, format_args!("{line}"))
}

/// Prints one row of a table; see [`tell`].
pub(super) fn row(writes: bool, figures: &Figures) -> Result<(), Failure> {
    tell(writes, format_args!("| {} |", cells(figures).join(" | ")))
}

/// Writes all figures as CSV, with a heading. Units are those of the JSON output.
pub(super) fn write_csv(all: &[Figures], mut out: impl Write) -> io::Result<()> {
    writeln!(
        out,
        "pair,method,device,seeds,points,epe,epe_low,epe_high,acc5,acc10,angle,epe_dynamic,\
         precompute_seconds,query_seconds,network_seconds,total_seconds,iterations,bytes,\
         target_bytes,cut,paper_epe,paper_acc5,paper_total_seconds"
    )?;
    let optional = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
    for row in all {
        let [epe, low, high] = row.epe;
        let plain = |text: &str| text.replace(['"', ',', '\n'], "_");
        let (pair, device) = (plain(&row.pair), plain(&row.device));
        writeln!(
            out,
            "{pair},{},{device},{},{},{epe},{low},{high},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
            row.method,
            row.seeds,
            row.points,
            row.acc5,
            row.acc10,
            row.angle,
            optional(row.epe_dynamic),
            row.precompute_seconds,
            row.query_seconds,
            row.network_seconds,
            row.total_seconds,
            optional(row.iterations.map(|count| count as f64)),
            row.bytes,
            optional(row.target_bytes.map(|bytes| bytes as f64)),
            row.cut,
            optional(row.paper_epe),
            optional(row.paper_acc5),
            optional(row.paper_total_seconds),
        )?;
    }
    Ok(())
}
