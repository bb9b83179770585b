//! The rows of the table: methods of FNSF's comparison, and what its paper reports for them.

use crate::flow::{BatchGrowth, LossOptions, Options, Preset, Renewal};

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
    preset: Preset,
    change: fn(&mut Options),
    pub(super) paper: PaperFigures,
}

const UNKNOWN: PaperFigures = PaperFigures {
    epe: None,
    acc5: None,
    total_seconds: None,
};

fn unchanged(_: &mut Options) {}

/// Renews the nearest neighbors in every `every`-th iteration, after the first 50.
fn renewed(options: &mut Options, every: usize) {
    if let Some(LossOptions::Chamfer(loss)) = options.field_mut().map(|field| &mut field.loss) {
        loss.renewal = Some(Renewal::after_warm_up(every));
    }
}

/// Starts with a sixteenth of the points.
fn grown(options: &mut Options, growth: BatchGrowth) {
    let points = options.max_points;
    if let Some(field) = options.field_mut() {
        field.batch = Some(points.map_or(4096, |points| points.div_ceil(16)));
        field.growth = Some(growth);
    }
}

/// All rows, in the order of the table.
pub(super) const ALL: [Row; 13] = [
    Row {
        name: "fnsf",
        about: "network, distance transform (preset paper)",
        preset: Preset::Paper,
        change: unchanged,
        paper: PaperFigures {
            epe: Some(0.071),
            acc5: Some(0.8005),
            total_seconds: Some(0.51),
        },
    },
    Row {
        name: "fnsf-linear",
        about: "linear model, distance transform",
        preset: Preset::FnsfLinear,
        change: unchanged,
        paper: PaperFigures {
            epe: Some(0.106),
            acc5: Some(0.65),
            total_seconds: Some(0.43),
        },
    },
    Row {
        name: "nsfp",
        about: "two networks, Chamfer distance, cycle",
        preset: Preset::Nsfp,
        change: unchanged,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-baseline",
        about: "network, Chamfer distance",
        preset: Preset::NsfpBaseline,
        change: unchanged,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-kdtree",
        about: "network, Chamfer distance, k-d trees",
        preset: Preset::NsfpKdtree,
        change: unchanged,
        paper: PaperFigures {
            total_seconds: Some(6.25),
            ..UNKNOWN
        },
    },
    Row {
        name: "nsfp-linear",
        about: "linear model, Chamfer distance",
        preset: Preset::NsfpLinear,
        change: unchanged,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-kdtree-linear",
        about: "linear model, Chamfer distance, k-d trees",
        preset: Preset::NsfpKdtreeLinear,
        change: unchanged,
        paper: PaperFigures {
            total_seconds: Some(3.09),
            ..UNKNOWN
        },
    },
    Row {
        name: "nsfp++",
        about: "two networks a cluster, Chamfer distance, ego motion out",
        preset: Preset::NsfpPlusPlus,
        change: unchanged,
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp++-dt",
        about: "two networks a cluster, distance transforms, ego motion out",
        preset: Preset::NsfpPlusPlusDt,
        change: unchanged,
        paper: UNKNOWN,
    },
    Row {
        name: "fnsf-sampled-time",
        about: "as fnsf, points double every 5 iterations from 1/16",
        preset: Preset::Paper,
        change: |options| grown(options, BatchGrowth::Iterations(5)),
        paper: UNKNOWN,
    },
    Row {
        name: "fnsf-sampled-loss",
        about: "as fnsf, points double at each 20% fall of the loss",
        preset: Preset::Paper,
        change: |options| grown(options, BatchGrowth::LossFall(0.2)),
        paper: UNKNOWN,
    },
    Row {
        name: "nsfp-kdtree-every-5",
        about: "as nsfp-kdtree, neighbors every 5th iteration after 50",
        preset: Preset::NsfpKdtree,
        change: |options| renewed(options, 5),
        paper: UNKNOWN,
    },
    Row {
        name: "default",
        about: "object search, ego motion out (not of the paper)",
        preset: Preset::Default,
        change: unchanged,
        paper: UNKNOWN,
    },
];

impl Row {
    /// The options of the row, with `max_points` points of each cloud.
    pub(super) fn options(&self, max_points: Option<usize>) -> Options {
        let mut options = self.preset.options(max_points);
        (self.change)(&mut options);
        options
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
