//! Object search with two sweeps and with neighbor sweeps: a table of `docs/experiments/neighbors.md`.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo bench --bench accuracy -- neighbors [--streets FROM..TO]
//! ```
//!
//! Ground points are taken from the masks of the sweeps, and the ego motion is estimated. The rows
//! are `kitti_0000` in the folder `FNSF_REAL_DATA` if it is set, with segmented ground in its later
//! sweeps. Then follow the means of streets of 64 and of 32 beams with five sweeps: the first pair,
//! and the one in the middle.

use super::clock::Clock;
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{Truth, evaluate};
use fnsf::flow::field::Backend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{self, Ground, Method, ObjectOptions, Point, Preset, Problem, Sweep};
use fnsf::formats::{read_cloud, read_pair};

/// Numbers of beams, first sweeps of the pairs, and the range of street seeds.
const BEAMS: [usize; 2] = [64, 32];
const PAIRS: [usize; 2] = [0, 2];
const STREETS: [u64; 2] = [0, 6];

/// A change of the options with a window of five sweeps.
type Change = fn(&mut ObjectOptions);

const VARIANTS: [(&str, Change); 5] = [
    ("two sweeps", |o| o.sweeps = 2),
    ("three sweeps", |o| o.sweeps = 3),
    ("five sweeps", |_| {}),
    ("what slides is never confirmed", |o| {
        o.neighbor_cost_ratio = 0.0;
    }),
    ("confirmed by more", |o| {
        o.neighbor_cost_ratio = 0.5;
        o.neighbor_gain_m = 0.1;
    }),
];

/// A pair with ground truth, and its neighbor sweeps by offset to the source.
struct LabelledPair {
    name: String,
    pair: [Sweep; 2],
    neighbors: Vec<(i8, Sweep)>,
    flow: Vec<Point>,
    valid: Vec<bool>,
    dynamic: Vec<bool>,
}

fn kitti() -> Result<Vec<LabelledPair>, String> {
    let Some(folder) = std::env::var_os("FNSF_REAL_DATA") else {
        return Ok(Vec::new());
    };
    let folder = std::path::Path::new(&folder).join("kitti_0000");
    let read = |name: &str| std::fs::read(folder.join(name)).map_err(|e| format!("{name}: {e}"));
    let pair = read_pair(&read("pair.npz")?).map_err(|e| e.to_string())?;
    let truth = pair.truth.ok_or("the pair has no truth")?;
    let ground = pair.ground.ok_or("the pair has no ground masks")?;
    let options = Preset::Label.options(None);
    let later = |at: i8| {
        let name = format!("{at:010}.pcd");
        let cloud = read_cloud(&read(&name)?, Some(&name)).map_err(|e| e.to_string())?;
        let sweep = Sweep {
            points: cloud.points,
            ground: None,
            ..Sweep::default()
        };
        Ok((at, sweep.prepared(&options)))
    };
    let sweep = |points, ground| Sweep {
        points,
        ground: Some(ground),
        ..Sweep::default()
    };
    Ok(vec![LabelledPair {
        name: "kitti_0000".to_owned(),
        pair: [
            sweep(pair.source, ground.source),
            sweep(pair.target, ground.target),
        ],
        neighbors: (2..5).map(later).collect::<Result<_, String>>()?,
        flow: truth.flow,
        valid: truth.valid,
        dynamic: truth.dynamic.ok_or("the pair does not say what moves")?,
    }])
}

fn street(beams: usize, seed: u64, first: usize) -> Result<LabelledPair, String> {
    let options = StreetOptions {
        seed,
        beams,
        sweeps: 5,
        ..StreetOptions::default()
    };
    let street = Street::new(&options).map_err(|e| e.to_string())?;
    let sweep = |frame| {
        let frame = street.sweep(frame).map_err(|e| e.to_string())?;
        Ok::<_, String>(Sweep {
            points: frame.points,
            ground: Some(frame.ground),
            ..Sweep::default()
        })
    };
    let truth = street.pair(first).map_err(|e| e.to_string())?;
    let neighbors = (0..5).filter(|&frame| frame != first && frame != first + 1);
    let neighbors = neighbors.map(|frame| Ok((frame as i8 - first as i8, sweep(frame)?)));
    Ok(LabelledPair {
        name: format!("streets, {beams} beams, pair {first}"),
        pair: [sweep(first)?, sweep(first + 1)?],
        neighbors: neighbors.collect::<Result<_, String>>()?,
        valid: vec![true; truth.source.len()],
        flow: truth.flow,
        dynamic: truth.dynamic,
    })
}

/// EPE of all points, of the moving points and of the static points, metres; then seconds.
type Row = [f64; 4];

fn searched(
    backend: &CpuBackend,
    known: &LabelledPair,
    label: &ObjectOptions,
) -> Result<Row, String> {
    let mut options = Preset::Label.options(None);
    options.ground = Ground::Mask;
    options.method = Method::Objects(label.clone());
    let [source, target] = &known.pair;
    let ground = source.ground.as_deref().zip(target.ground.as_deref());
    let neighbors: Vec<_> = known
        .neighbors
        .iter()
        .map(|(at, sweep)| sweep.as_neighbor(*at))
        .collect();
    let problem = Problem {
        source: &source.points,
        target: &target.points,
        ground: ground.map(|(source, target)| [source, target]),
        times: None,
        before: None,
        neighbors: &neighbors,
    };
    let clock = Clock::start();
    backend.host().clear_cache();
    let found = flow::estimate(backend, &problem, &options, &clock).map_err(|e| e.to_string())?;
    let truth = Truth {
        dynamic: Some(&known.dynamic),
        ground: source.ground.as_deref(),
        source: Some(&source.points),
        ..Truth::new(&known.flow, &known.valid)
    };
    let metrics = evaluate(&found.flow, &found.valid, &truth).map_err(|e| e.to_string())?;
    Ok([
        metrics.epe,
        metrics.epe_dynamic.unwrap_or(f64::NAN),
        metrics.epe_static.unwrap_or(f64::NAN),
        found.total_seconds,
    ])
}

fn mean(rows: &[Row]) -> Row {
    let count = rows.len() as f64;
    core::array::from_fn(|column| rows.iter().map(|row| row[column]).sum::<f64>() / count)
}

/// The requested range of street seeds: the first, and one past the last.
fn seeds(arguments: Vec<String>) -> Result<[u64; 2], String> {
    let mut arguments = arguments.into_iter();
    match (arguments.next().as_deref(), arguments.next()) {
        (None, _) => Ok(STREETS),
        (Some("--streets"), Some(range)) => {
            let (from, to) = range.split_once("..").ok_or("streets are FROM..TO")?;
            let number = |text: &str| text.parse().map_err(|e| format!("{text}: {e}"));
            Ok([number(from)?, number(to)?])
        }
        _ => Err("there is only --streets FROM..TO".to_owned()),
    }
}

pub(super) fn run(arguments: Vec<String>) -> Result<(), String> {
    let [from, to] = seeds(arguments)?;
    let mut groups = vec![kitti()?];
    for beams in BEAMS {
        for first in PAIRS {
            let streets = (from..to).map(|seed| street(beams, seed, first));
            groups.push(streets.collect::<Result<_, _>>()?);
        }
    }
    groups.retain(|group| !group.is_empty());
    let backend = CpuBackend::new(None).map_err(|e| e.to_string())?;
    println!("| variant | pairs | EPE | EPE moving | EPE static | s |");
    println!("|---|---|---|---|---|---|");
    for (variant, change) in VARIANTS {
        let mut label = ObjectOptions {
            sweeps: 5,
            ..ObjectOptions::default()
        };
        change(&mut label);
        for group in &groups {
            let rows = group.iter().map(|known| searched(&backend, known, &label));
            let rows: Vec<Row> = rows.collect::<Result<_, _>>()?;
            let [epe, moving, still, seconds] = mean(&rows);
            let name = &group[0].name;
            println!("| {variant} | {name} | {epe:.4} | {moving:.4} | {still:.4} | {seconds:.2} |");
        }
    }
    Ok(())
}
