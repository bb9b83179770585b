//! The plots of the tables, as SVG.

use std::io::Write as _;
use std::path::Path;

use super::cells::{CellFigures, Measured};
use super::figures::Figures;
use crate::cli::failure::Failure;
use crate::cli::files;
use crate::picture::{Axis, Plot, Series};

const SECONDS: Axis<'static> = Axis {
    title: "time in all, s",
    is_logarithmic: true,
};
const ERROR: Axis<'static> = Axis {
    title: "mean end-point error, m",
    is_logarithmic: false,
};
const CELL: Axis<'static> = Axis {
    title: "edge of a cell, m",
    is_logarithmic: true,
};

/// The names of the pairs, each once, in order.
fn pairs<'a>(names: impl Iterator<Item = &'a String>) -> Vec<&'a String> {
    let mut pairs: Vec<&String> = Vec::new();
    for name in names {
        if !pairs.contains(&name) {
            pairs.push(name);
        }
    }
    pairs
}

/// Writes `time_error.svg`, and with an ablation `cells_error.svg`, `cells_time.svg` and
/// `cells_memory.svg`, to `folder`.
pub(super) fn write(
    folder: &Path,
    figures: &[Figures],
    cells: &[CellFigures],
) -> Result<(), Failure> {
    let methods = pairs(figures.iter().map(|row| &row.pair)).into_iter();
    let methods = methods.map(|pair| Series {
        name: pair.clone(),
        points: figures
            .iter()
            .filter(|row| row.pair == *pair)
            .map(|row| (row.total_seconds, row.epe[0], row.method.to_owned()))
            .collect(),
        is_joined: false,
    });
    put(
        folder,
        "time_error.svg",
        &Plot {
            title: "Error against time",
            axes: [SECONDS, ERROR],
            series: methods.collect(),
        },
    )?;
    if cells.is_empty() {
        return Ok(());
    }
    let of = |value: fn(&Measured) -> f64| -> Vec<Series> {
        let pairs = pairs(cells.iter().map(|row| &row.pair)).into_iter();
        let series = pairs.map(|pair| {
            let rows = cells.iter().filter(|row| row.pair == *pair);
            let points = rows.filter_map(|row| {
                let measured = row.measured.as_ref()?;
                Some((row.cell_m, value(measured), String::new()))
            });
            Series {
                name: pair.clone(),
                points: points.collect(),
                is_joined: true,
            }
        });
        series.collect()
    };
    let memory = Axis {
        title: "distance transform, MB",
        is_logarithmic: true,
    };
    for (name, title, axis, series) in [
        (
            "cells_error.svg",
            "Error against cell size",
            ERROR,
            of(|row| row.epe),
        ),
        (
            "cells_time.svg",
            "Time against cell size",
            SECONDS,
            of(|row| row.total_seconds),
        ),
        (
            "cells_memory.svg",
            "Memory against cell size",
            memory,
            of(|row| row.transform_bytes as f64 / 1e6),
        ),
    ] {
        put(
            folder,
            name,
            &Plot {
                title,
                axes: [CELL, axis],
                series,
            },
        )?;
    }
    Ok(())
}

fn put(folder: &Path, name: &str, plot: &Plot<'_>) -> Result<(), Failure> {
    files::write(&folder.join(name), |file| {
        file.write_all(plot.to_svg().as_bytes())
    })
}
