//! Ablation of the object search on labelled pairs and simulated streets, next to the other
//! presets: a table of `docs/experiments/objects.md`.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench accuracy -- objects [--only NAME] [--seeds N]
//! ```
//!
//! Ground points are taken from the masks of the pairs, and the ego motion is estimated. The rows
//! are `av2_7fab`, `kitti_0000` and `small_gicp` in the folder `FNSF_REAL_DATA` if it is set, then
//! the means of ten streets of 64 and of 32 beams. Presets that depend on the seed report the
//! median over the seeds.

use super::clock::Clock;
use super::labelled::{LabelledPair, real_pairs, street};
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{Truth, evaluate};
use fnsf::flow::field::Backend;
use fnsf::flow::{self, Ground, ObjectOptions, Options, Preset, Problem};

/// Numbers of beams, and the number of streets of each.
const BEAMS: [usize; 2] = [64, 32];
const STREETS: u64 = 10;

/// A preset with a named change of its options.
struct Variant {
    name: &'static str,
    preset: Preset,
    change: fn(&mut ObjectOptions),
}

const fn label(name: &'static str, change: fn(&mut ObjectOptions)) -> Variant {
    Variant {
        name,
        preset: Preset::Label,
        change,
    }
}

const fn preset(name: &'static str, preset: Preset) -> Variant {
    Variant {
        name,
        preset,
        change: |_| {},
    }
}

const VARIANTS: &[Variant] = &[
    preset("paper", Preset::Paper),
    preset("neural", Preset::Neural),
    preset("label", Preset::Label),
    // More evidence than any cluster has.
    label("ego motion alone", |o| o.min_evidence_m = f32::INFINITY),
    label("no starts but none", |o| o.initial_guesses = 0),
    label("starts whatever none leaves", |o| o.close_fit_m = 0.0),
    label("starts compared without the way", |o| {
        o.displacement_penalty = 0.0;
    }),
    label("distances to points, no normals", |o| o.normal_m = [0.0; 2]),
    label("distances to planes alone", |o| o.tangential_weight = 0.0),
    label("heights count in full", |o| o.height_weight = 1.0),
    label("nothing is taken by what stands still", |o| {
        o.static_match_m = 0.0;
    }),
    label("no evidence asked for", |o| {
        o.min_evidence_m = 0.0;
        o.min_evidence_slope = 0.0;
    }),
    label("evidence whatever the way", |o| {
        o.min_evidence_m = 3.0;
        o.min_evidence_slope = 0.0;
    }),
    label("what is seen to have gone needs hold, too", |o| {
        o.min_free_space = f32::INFINITY;
    }),
    label("what is seen to have stayed may move", |o| {
        o.min_free_space_far = 0.0;
    }),
    label("walls may slide", |o| o.min_observability = 0.0),
    label("rotation is no evidence", |o| {
        o.min_normal_motion_m = f32::INFINITY;
    }),
    label("moved clusters may lie anywhere", |o| {
        o.max_residual_m = f32::INFINITY;
    }),
    label("any part of the cost may be left", |o| {
        o.max_cost_ratio = 1.0;
    }),
    label("flat clusters may move", |o| o.ground_thickness_m = 0.0),
    label("no gate at all", |o| {
        o.min_evidence_m = 0.0;
        o.min_evidence_slope = 0.0;
        o.min_observability = 0.0;
        o.min_free_space_far = 0.0;
        o.max_residual_m = f32::INFINITY;
        o.max_cost_ratio = 1.0;
        o.ground_thickness_m = 0.0;
        o.min_gain_m = 0.0;
    }),
    label("pieces go by themselves", |o| o.adjacent_cost_ratio = 0.0),
    label("clusters move whole", |o| o.point_reject_m = f32::INFINITY),
    label("clusters of 0.35 m", |o| o.cluster_radius_m = 0.35),
    label("clusters of 0.7 m", |o| o.cluster_radius_m = 0.7),
    label("thinned to 0.2 m", |o| o.voxel_m = 0.2),
    label("matches within 0.5 m", |o| o.match_m = 0.5),
    label("matches within 1 m", |o| o.match_m = 1.0),
];

/// EPE of all points, of the moving points, of the static points, and three-way EPE of the dynamic
/// foreground where all moving points count as foreground, metres; then seconds.
type Row = [f64; 5];

fn searched(backend: &CpuBackend, pair: &LabelledPair, options: &Options) -> Result<Row, String> {
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: Some([&pair.ground[0], &pair.ground[1]]),
        times: None,
        before: None,
        neighbors: &[],
    };
    let clock = Clock::start();
    backend.host().clear_cache();
    let estimate = flow::estimate(backend, &problem, options, &clock).map_err(|e| e.to_string())?;
    let dynamic = pair.dynamic.as_deref();
    let truth = Truth {
        dynamic,
        foreground: dynamic,
        ground: Some(&pair.ground[0]),
        source: Some(&pair.source),
        ..Truth::new(&pair.flow, &pair.valid)
    };
    let metrics = evaluate(&estimate.flow, &estimate.valid, &truth).map_err(|e| e.to_string())?;
    let close = |part: fn(&flow::evaluate::ThreeWay) -> Option<f64>| {
        metrics
            .three_way
            .as_ref()
            .and_then(part)
            .unwrap_or(f64::NAN)
    };
    Ok([
        metrics.epe,
        metrics.epe_dynamic.unwrap_or(f64::NAN),
        metrics.epe_static.unwrap_or(f64::NAN),
        close(|three_way| three_way.foreground_dynamic.epe),
        estimate.total_seconds,
    ])
}

/// The upper median of each column.
fn median(rows: &[Row]) -> Row {
    core::array::from_fn(|column| {
        let mut values: Vec<f64> = rows.iter().map(|row| row[column]).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    })
}

fn mean(rows: &[Row]) -> Row {
    let count = rows.len() as f64;
    core::array::from_fn(|column| rows.iter().map(|row| row[column]).sum::<f64>() / count)
}

pub(super) fn run(arguments: Vec<String>) -> Result<(), String> {
    let mut only = String::new();
    let mut seeds = 1;
    let mut arguments = arguments.into_iter();
    while let Some(argument) = arguments.next() {
        let value = arguments
            .next()
            .ok_or(format!("{argument} needs a value"))?;
        match argument.as_str() {
            "--only" => only = value,
            "--seeds" => seeds = value.parse::<u64>().map_err(|e| e.to_string())?.max(1),
            other => return Err(format!("{other} is not known")),
        }
    }
    let pairs = real_pairs()?.into_iter();
    let mut groups: Vec<(String, Vec<LabelledPair>)> =
        pairs.map(|pair| (pair.name.clone(), vec![pair])).collect();
    for beams in BEAMS {
        let streets = (0..STREETS).map(|seed| street(seed, beams));
        let streets = streets.collect::<Result<_, _>>()?;
        groups.push((format!("{STREETS} streets, {beams} beams"), streets));
    }
    let backend = CpuBackend::new(None).map_err(|e| e.to_string())?;
    println!("| variant | pair | EPE | EPE moving | EPE static | EPE moving, close | s |");
    println!("|---|---|---|---|---|---|---|");
    for variant in VARIANTS {
        if !only.is_empty() && variant.name != only {
            continue;
        }
        let mut options = variant.preset.options(None);
        options.ground = Ground::Mask;
        if let Some(objects) = options.objects_mut() {
            (variant.change)(objects);
        }
        let draws = if options.field().is_some() { seeds } else { 1 };
        for (name, group) in &groups {
            let mut rows = Vec::new();
            for pair in group {
                let mut of_seeds = Vec::new();
                for seed in 0..draws {
                    options.seed = seed;
                    of_seeds.push(searched(&backend, pair, &options)?);
                }
                rows.push(median(&of_seeds));
            }
            let [epe, moving, still, close, seconds] = mean(&rows);
            let variant = variant.name;
            println!(
                "| {variant} | {name} | {epe:.4} | {moving:.3} | {still:.4} | {close:.3} | {seconds:.2} |"
            );
        }
    }
    Ok(())
}
