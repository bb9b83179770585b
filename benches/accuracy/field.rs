//! Ablation of the `neural` and `paper` presets on pairs with ground truth: a table of
//! `docs/experiments/field.md`.
//!
//! ```text
//! cargo bench --bench accuracy -- field [--seeds N] [--max-points N] [--only NAME] PAIR.npz...
//! ```
//!
//! Each row is one variant on one pair, over all seeds: median EPE, the worst EPE divided by the
//! median, median Acc5, median EPE of moving points, median iterations and seconds.

use super::clock::Clock;
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::distance::{Metric, Sites};
use fnsf::flow::evaluate::{Truth, evaluate};
use fnsf::flow::field::Backend;
use fnsf::flow::{
    self, DistanceLossOptions, EarlyStopOptions, Ego, FieldOptions, Ground, InputNormalization,
    LearningRateSchedule, NetworkOptions, Options, Preset, Problem, ResultChoice, Start,
};
use fnsf::formats::{Pair, read_pair};

fn field(options: &mut Options) -> &mut FieldOptions {
    options
        .field_mut()
        .expect("the presets of this table fit a field")
}

fn network(options: &mut Options) -> &mut NetworkOptions {
    let network = field(options).network_mut();
    network.expect("the presets of this table fit a network")
}

fn distance_loss(options: &mut Options) -> &mut DistanceLossOptions {
    let loss = field(options).loss.distance_mut();
    loss.expect("the presets of this table use a distance transform")
}

/// A preset with a named change of its options.
struct Variant {
    name: &'static str,
    preset: Preset,
    change: fn(&mut Options),
}

const fn paper(name: &'static str, change: fn(&mut Options)) -> Variant {
    Variant {
        name,
        preset: Preset::Paper,
        change,
    }
}

const fn ours(name: &'static str, change: fn(&mut Options)) -> Variant {
    Variant {
        name,
        preset: Preset::Neural,
        change,
    }
}

/// Stops after 100 iterations without a decrease of the loss by 0.05 mm.
const PATIENT: EarlyStopOptions = EarlyStopOptions {
    patience: 100,
    min_delta: 5e-5,
};

const VARIANTS: &[Variant] = &[
    paper("paper", |_| {}),
    paper("paper, chamfer transform", |o| {
        distance_loss(o).transform.metric = Metric::Chamfer;
    }),
    paper("paper, exact points", |o| {
        distance_loss(o).transform.sites = Sites::Points;
    }),
    paper("paper, patience 100, 0.05 mm, 400 iterations", |o| {
        field(o).early_stop = Some(PATIENT);
        field(o).max_iterations = 400;
    }),
    paper("paper, centered inputs / 20 m", |o| {
        network(o).inputs = InputNormalization::Centered { scale_m: 20.0 };
    }),
    paper("paper, zero start", |o| {
        network(o).start = Start::ZeroFlow;
    }),
    paper("paper, truncation 2 m", |o| {
        distance_loss(o).truncation_m = Some(2.0);
    }),
    paper("paper, ego motion first", |o| o.ego = Ego::Auto),
    paper("paper, ego motion first, centered, zero start", |o| {
        o.ego = Ego::Auto;
        network(o).inputs = InputNormalization::Centered { scale_m: 20.0 };
        network(o).start = Start::ZeroFlow;
    }),
    paper(
        "paper, batches of 2,048, cosine, average, 150 iterations",
        |o| {
            field(o).batch = Some(2048);
            field(o).learning_rate_schedule = LearningRateSchedule::Cosine;
            field(o).result = ResultChoice::Average { decay: 0.9 };
            field(o).early_stop = None;
            field(o).max_iterations = 150;
        },
    ),
    ours("neural", |_| {}),
    ours("neural, ego motion alone", |o| {
        field(o).max_iterations = 0;
    }),
    ours("neural, no ego motion", |o| o.ego = Ego::Off),
    ours("neural, no margin", no_margin),
    ours("neural, margin 0.1 m at every range", |o| {
        distance_loss(o).margin_quantile = None;
    }),
    ours("neural, margin from 70% of the points", |o| {
        distance_loss(o).margin_quantile = Some(0.7);
    }),
    ours("neural, margin from 80% of the points", |o| {
        distance_loss(o).margin_quantile = Some(0.8);
    }),
    ours("neural, no flow penalty", |o| {
        distance_loss(o).flow_penalty = 0.0;
    }),
    ours("neural, no margin, no flow penalty", |o| {
        no_margin(o);
        distance_loss(o).flow_penalty = 0.0;
    }),
    ours("neural, flow penalty 0.01", |o| {
        distance_loss(o).flow_penalty = 0.01;
    }),
    ours("neural, flow penalty 0.05", |o| {
        distance_loss(o).flow_penalty = 0.05;
    }),
    ours("neural, no truncation", |o| {
        distance_loss(o).truncation_m = None;
    }),
    ours("neural, truncation 0.5 m", |o| {
        distance_loss(o).truncation_m = Some(0.5);
    }),
    ours("neural, truncation 2 m", |o| {
        distance_loss(o).truncation_m = Some(2.0);
    }),
    ours("neural, raw inputs", |o| {
        network(o).inputs = InputNormalization::Raw;
    }),
    ours("neural, centered / 5 m", |o| {
        network(o).inputs = InputNormalization::Centered { scale_m: 5.0 };
    }),
    ours("neural, centered / 20 m", |o| {
        network(o).inputs = InputNormalization::Centered { scale_m: 20.0 };
    }),
    ours("neural, centered / 50 m", |o| {
        network(o).inputs = InputNormalization::Centered { scale_m: 50.0 };
    }),
    ours("neural, Xavier start", |o| {
        network(o).start = Start::Xavier;
    }),
    ours("neural, exact points", |o| {
        distance_loss(o).transform.sites = Sites::Points;
    }),
    ours("neural, step size 0.008", |o| {
        field(o).learning_rate = 0.008;
    }),
    ours("neural, constant step size", |o| {
        field(o).learning_rate_schedule = LearningRateSchedule::Constant;
    }),
    ours("neural, best batch instead of average", |o| {
        field(o).result = ResultChoice::Best;
    }),
    ours("neural, batches of 1,024", |o| {
        field(o).batch = Some(1024);
    }),
    ours("neural, batches of 4,096", |o| {
        field(o).batch = Some(4096);
    }),
    ours("neural, all points each iteration", |o| {
        field(o).batch = None;
    }),
    ours("neural, 75 iterations", |o| {
        field(o).max_iterations = 75;
    }),
    ours("neural, 300 iterations", |o| {
        field(o).max_iterations = 300;
    }),
    ours("neural, 600 iterations", |o| {
        field(o).max_iterations = 600;
    }),
    ours("neural, 1,024 a batch, 300 iterations", |o| {
        field(o).batch = Some(1024);
        field(o).max_iterations = 300;
    }),
];

fn no_margin(options: &mut Options) {
    distance_loss(options).margin_m = 0.0;
    distance_loss(options).margin_quantile = None;
}

/// The result of one seed.
struct Run {
    epe: f64,
    acc5: f64,
    moving: f64,
    iterations: f64,
    seconds: f64,
}

fn fitted(backend: &CpuBackend, pair: &Pair, options: &Options) -> Result<Run, String> {
    let ground = pair.ground.as_ref();
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: ground.map(|g| [g.source.as_slice(), g.target.as_slice()]),
        times: None,
        before: None,
        neighbors: &[],
    };
    let clock = Clock::start();
    backend.host().clear_cache();
    let estimate = flow::estimate(backend, &problem, options, &clock).map_err(|e| e.to_string())?;
    let known = pair.truth.as_ref().ok_or("the pair has no truth")?;
    let truth = Truth {
        dynamic: known.dynamic.as_deref(),
        ground: ground.map(|g| g.source.as_slice()),
        ..Truth::new(&known.flow, &known.valid)
    };
    let metrics = evaluate(&estimate.flow, &estimate.valid, &truth).map_err(|e| e.to_string())?;
    Ok(Run {
        epe: metrics.epe,
        acc5: metrics.acc5,
        moving: metrics.epe_dynamic.unwrap_or(f64::NAN),
        iterations: estimate.fit().expect("a fit").iterations as f64,
        seconds: estimate.total_seconds,
    })
}

/// The upper median of the values, and the largest.
fn median_and_worst(runs: &[Run], value: fn(&Run) -> f64) -> [f64; 2] {
    let mut values: Vec<f64> = runs.iter().map(value).collect();
    values.sort_by(f64::total_cmp);
    [values[values.len() / 2], values[values.len() - 1]]
}

pub(super) fn run(arguments: Vec<String>) -> Result<(), String> {
    let mut seeds = 5;
    let mut max_points = None;
    let mut only = String::new();
    let mut pairs = Vec::new();
    let mut arguments = arguments.into_iter();
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().ok_or(format!("{argument} needs a value"));
        let number = |text: String| text.parse::<usize>().map_err(|e| e.to_string());
        match argument.as_str() {
            "--seeds" => seeds = number(value()?)?.max(1),
            "--max-points" => max_points = Some(number(value()?)?),
            "--only" => only = value()?,
            path => {
                let bytes = std::fs::read(path).map_err(|e| format!("{path}: {e}"))?;
                let pair = read_pair(&bytes).map_err(|e| format!("{path}: {e}"))?;
                pairs.push((path.to_owned(), pair));
            }
        }
    }
    let backend = CpuBackend::new(None).map_err(|e| e.to_string())?;
    println!("| variant | pair | EPE | worst / median | Acc5 | EPE moving | iterations | s |");
    println!("|---|---|---|---|---|---|---|---|");
    for variant in VARIANTS
        .iter()
        .filter(|v| only.is_empty() || v.name == only)
    {
        for (path, pair) in &pairs {
            let mut options = variant.preset.options(max_points);
            options.ground = if pair.ground.is_some() {
                Ground::Mask
            } else {
                Ground::Keep
            };
            (variant.change)(&mut options);
            let runs: Result<Vec<Run>, String> = (0..seeds)
                .map(|seed| {
                    options.seed = seed as u64;
                    fitted(&backend, pair, &options)
                })
                .collect();
            let name = std::path::Path::new(path)
                .parent()
                .and_then(|p| p.file_name());
            let name = name.map_or(path.clone(), |name| name.to_string_lossy().into_owned());
            match runs {
                Ok(runs) => {
                    let [epe, worst] = median_and_worst(&runs, |r| r.epe);
                    let [acc5, _] = median_and_worst(&runs, |r| r.acc5);
                    let [moving, _] = median_and_worst(&runs, |r| r.moving);
                    let [iterations, _] = median_and_worst(&runs, |r| r.iterations);
                    let [seconds, _] = median_and_worst(&runs, |r| r.seconds);
                    println!(
                        "| {} | {name} | {epe:.4} | {:.2} | {acc5:.3} | {moving:.3} | {iterations:.0} | {seconds:.2} |",
                        variant.name,
                        worst / epe
                    );
                }
                Err(error) => println!("| {} | {name} | {error} | | | | | |", variant.name),
            }
        }
    }
    Ok(())
}
