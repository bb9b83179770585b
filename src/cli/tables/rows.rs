//! The rows of the table: methods of FNSF's comparison, and what its paper reports for them.

use crate::job::{FieldChoices, JobOptions, PresetChoice};

/// What the paper reports for a method on full Argoverse clouds. None where it is not known here.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PaperFigures {
    /// Mean end-point error, metres.
    pub(super) epe: Option<f64>,
    /// Acc5, 0 to 1.
    pub(super) acc5: Option<f64>,
    /// Seconds in all, on one RTX 3090 Ti.
    pub(super) total_seconds: Option<f64>,
}

/// One row: a method under a name.
#[derive(Clone, Copy)]
pub(super) struct Row {
    pub(super) name: &'static str,
    /// What the row shows, in a few words.
    pub(super) about: &'static str,
    preset: PresetChoice,
    /// Options of the fit of so many points.
    field: fn(usize) -> FieldChoices,
    pub(super) paper: PaperFigures,
}

const UNKNOWN: PaperFigures = PaperFigures {
    epe: None,
    acc5: None,
    total_seconds: None,
};

/// The options of the preset.
fn usual(_: usize) -> FieldChoices {
    FieldChoices::default()
}

/// A sixteenth of the larger cloud's points at first.
fn sampled(points: usize) -> FieldChoices {
    FieldChoices {
        first_points: u32::try_from(points.div_ceil(16)).ok(),
        ..FieldChoices::default()
    }
}

/// All rows, in the order of the table.
pub(super) const ALL: [Row; 13] = [
    Row {
        name: "fnsf",
        about: "network, distance transform (preset paper)",
        preset: PresetChoice::Paper,
        field: usual,
        paper: PaperFigures {
            epe: Some(0.071),
            acc5: Some(0.8005),
            total_seconds: Some(0.51),
        },
    },
    Row {
        name: "fnsf-linear",
        about: "linear model, distance transform",
        preset: PresetChoice::FnsfLinear,
        field: usual,
        paper: PaperFigures {
            epe: Some(0.106),
            acc5: Some(0.65),
            total_seconds: Some(0.43),
        },
    },
    Row {
        name: "nsfp",
        about: "two networks, Chamfer distance, cycle",
        preset: PresetChoice::Nsfp,
        field: usual,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-baseline",
        about: "network, Chamfer distance",
        preset: PresetChoice::NsfpBaseline,
        field: usual,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-kdtree",
        about: "network, Chamfer distance, k-d trees",
        preset: PresetChoice::NsfpKdtree,
        field: usual,
        paper: PaperFigures {
            total_seconds: Some(6.25),
            ..UNKNOWN
        },
    },
    Row {
        name: "nsfp-linear",
        about: "linear model, Chamfer distance",
        preset: PresetChoice::NsfpLinear,
        field: usual,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-kdtree-linear",
        about: "linear model, Chamfer distance, k-d trees",
        preset: PresetChoice::NsfpKdtreeLinear,
        field: usual,
        paper: PaperFigures {
            total_seconds: Some(3.09),
            ..UNKNOWN
        },
    },
    Row {
        name: "nsfp++",
        about: "two networks a cluster, Chamfer distance, ego motion out",
        preset: PresetChoice::NsfpPlusPlus,
        field: usual,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp++-dt",
        about: "two networks a cluster, distance transforms, ego motion out",
        preset: PresetChoice::NsfpPlusPlusDt,
        field: usual,
        paper: UNKNOWN,
    },
    Row {
        name: "fnsf-sampled-time",
        about: "as fnsf, points double every 5 iterations from 1/16",
        preset: PresetChoice::Paper,
        field: |points| FieldChoices {
            double_every: Some(5),
            ..sampled(points)
        },
        paper: UNKNOWN,
    },
    Row {
        name: "fnsf-sampled-loss",
        about: "as fnsf, points double at each 20% fall of the loss",
        preset: PresetChoice::Paper,
        field: |points| FieldChoices {
            double_at_fall: Some(0.2),
            ..sampled(points)
        },
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-kdtree-every-5",
        about: "as nsfp-kdtree, neighbors every 5th iteration after 50",
        preset: PresetChoice::NsfpKdtree,
        field: |_| FieldChoices {
            renew_every: Some(5),
            ..FieldChoices::default()
        },
        paper: UNKNOWN,
    },
    Row {
        name: "default",
        about: "object search, ego motion out (not of the paper)",
        preset: PresetChoice::Default,
        field: usual,
        paper: UNKNOWN,
    },
];

impl Row {
    /// The options of the row. `points` is the number of points of the larger cloud, or of its sample.
    pub(super) fn options(&self, points: usize) -> JobOptions {
        JobOptions {
            preset: self.preset,
            field: (self.field)(points),
            ..JobOptions::default()
        }
    }

    /// The row with this name.
    pub(super) fn named(name: &str) -> Option<Self> {
        ALL.into_iter().find(|row| row.name == name)
    }
}

/// The names of all rows.
pub(super) fn names() -> String {
    ALL.map(|row| row.name).join(", ")
}
