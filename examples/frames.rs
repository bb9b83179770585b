//! The table of `docs/numerics.md` on several frames: movers found in two sweeps, and with others of
//! the sequence around them.
//!
//! ```text
//! FNSF_REAL_DATA=... cargo run --release --example frames -- [--seeds FROM..TO]
//! ```
#![expect(
    clippy::print_stdout,
    reason = "the table is the answer of this program"
)]

use std::time::Instant;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::evaluate::{Truth, evaluate};
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{self, Around, Ground, LabelOptions, Point, Preset, Problem, Sweep, Watch};
use fnsf::formats::{read_cloud, read_pair};

struct Clock(Instant);

impl Watch for Clock {
    fn seconds(&self) -> f64 {
        self.0.elapsed().as_secs_f64()
    }
}

/// A pair with what is true of it, and the sweeps around it.
struct Known {
    name: String,
    pair: [Sweep; 2],
    around: Vec<(i8, Sweep)>,
    flow: Vec<Point>,
    valid: Vec<bool>,
    dynamic: Vec<bool>,
}

fn kitti() -> Result<Vec<Known>, String> {
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
        };
        Ok((at, sweep.prepared(&options)))
    };
    let sweep = |points, ground| Sweep {
        points,
        ground: Some(ground),
    };
    Ok(vec![Known {
        name: "kitti_0000".to_owned(),
        pair: [
            sweep(pair.source, ground.source),
            sweep(pair.target, ground.target),
        ],
        around: (2..5).map(later).collect::<Result<_, String>>()?,
        flow: truth.flow,
        valid: truth.valid,
        dynamic: truth.dynamic.ok_or("the pair does not say what moves")?,
    }])
}

fn street(beams: usize, seed: u64, first: usize) -> Result<Known, String> {
    let options = StreetOptions {
        seed,
        beams,
        frames: 5,
        ..StreetOptions::default()
    };
    let street = Street::new(&options).map_err(|e| e.to_string())?;
    let sweep = |frame| {
        let frame = street.frame(frame).map_err(|e| e.to_string())?;
        Ok::<_, String>(Sweep {
            points: frame.points,
            ground: Some(frame.ground),
        })
    };
    let truth = street.pair(first).map_err(|e| e.to_string())?;
    let around = (0..5).filter(|&frame| frame != first && frame != first + 1);
    let around = around.map(|frame| Ok((frame as i8 - first as i8, sweep(frame)?)));
    Ok(Known {
        name: format!("streets, {beams} beams, pair {first}"),
        pair: [sweep(first)?, sweep(first + 1)?],
        around: around.collect::<Result<_, String>>()?,
        valid: vec![true; truth.source.len()],
        flow: truth.flow,
        dynamic: truth.dynamic,
    })
}

/// EPE, that of movers, that of what stands still, seconds.
type Row = [f64; 4];

fn run(backend: &CpuBackend, known: &Known, label: &LabelOptions) -> Result<Row, String> {
    let mut options = Preset::Label.options(None);
    options.ground = Ground::Mask;
    options.label = Some(label.clone());
    let [source, target] = &known.pair;
    let ground = source.ground.as_deref().zip(target.ground.as_deref());
    let around: Vec<Around> = known
        .around
        .iter()
        .map(|(at, sweep)| Around {
            points: &sweep.points,
            ground: sweep.ground.as_deref(),
            at: *at,
        })
        .collect();
    let problem = Problem {
        source: &source.points,
        target: &target.points,
        ground: ground.map(|(source, target)| [source, target]),
        before: None,
        around: &around,
    };
    let clock = Clock(Instant::now());
    let found = flow::estimate(backend, &problem, &options, &clock).map_err(|e| e.to_string())?;
    let truth = Truth {
        dynamic: Some(&known.dynamic),
        ground: source.ground.as_deref(),
        source: Some(&source.points),
        ..Truth::new(&known.flow, &known.valid)
    };
    let metrics = evaluate(&found.flow, &found.valid, &truth).map_err(|e| e.to_string())?;
    if std::env::var_os("DIAG").is_some() {
        diag(known, &found);
    }
    Ok([
        metrics.epe,
        metrics.epe_dynamic.unwrap_or(f64::NAN),
        metrics.epe_static.unwrap_or(f64::NAN),
        found.seconds.total,
    ])
}

fn diag(known: &Known, found: &flow::Estimate) {
    let g = known.pair[0].ground.as_ref().unwrap();
    let len = |v: Point| v.iter().map(|x| x * x).sum::<f32>().sqrt();
    let dyn_found = found.dynamic.as_ref().unwrap();
    let mut s = [(0.0f32, 0usize); 5];
    let mut n = 0;
    let mut cells: std::collections::BTreeMap<[i32; 2], (usize, Point)> = Default::default();
    for i in 0..known.flow.len() {
        if g[i] || !known.valid[i] { continue; }
        let e = len(core::array::from_fn(|a| found.flow[i][a] - known.flow[i][a]));
        let c = match (known.dynamic[i], dyn_found[i]) {
            (true, false) => 0,
            (true, true) if e > 0.15 => 1,
            (true, true) => 2,
            (false, true) => 3,
            (false, false) => 4,
        };
        if c == 0 && std::env::var_os("CELLS").is_some() { let p = known.pair[0].points[i]; let k = [0,1].map(|a| (p[a] / 3.0).floor() as i32); cells.entry(k).or_insert((0, known.flow[i])).0 += 1; }
        n += usize::from(known.dynamic[i]);
        s[c].0 += e; s[c].1 += 1;
    }
    for (k, (n, f)) in cells { if n > 40 { println!("   missed cell {} {}: {n} {f:?}", k[0] * 3, k[1] * 3); } }
    let n = n as f32;
    println!("   missed {:.4} ({}) wrong {:.4} ({}) imprecise {:.4} ({}) | false {:.1} m ({}) static {:.1} m ({}) of {n}", s[0].0/n, s[0].1, s[1].0/n, s[1].1, s[2].0/n, s[2].1, s[3].0, s[3].1, s[4].0, s[4].1);
}

fn mean(rows: &[Row]) -> Row {
    let count = rows.len() as f64;
    core::array::from_fn(|column| rows.iter().map(|row| row[column]).sum::<f64>() / count)
}

fn main() -> Result<(), String> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (from, to) = (args[0].parse::<u64>().unwrap(), args[1].parse::<u64>().unwrap());
    let mut groups = vec![kitti()?];
    for beams in [64, 32] {
        for first in [0, 2] {
            let streets = (from..to).map(|seed| street(beams, seed, first));
            groups.push(streets.collect::<Result<_, _>>()?);
        }
    }
    let backend = CpuBackend::new(None).map_err(|e| e.to_string())?;
    for spec in &args[2..] {
        let f: Vec<f32> = spec.split(':').map(|x| x.parse().unwrap()).collect();
        let mut label = LabelOptions::default();
        label.frames = f[0] as usize;
        label.x = f[1] as u32;
        if f.len() > 2 { label.around_power = f[2]; }
        if f.len() > 3 { label.around_weight = f[3]; }
        if f.len() > 4 { label.confirmed_cost = f[4]; }
        if f.len() > 5 { label.confirmed_m = f[5]; }
        let mut line = format!("{spec:>12} |");
        for group in &groups {
            let rows: Vec<Row> = group.iter().map(|k| run(&backend, k, &label)).collect::<Result<_, _>>()?;
            if std::env::var_os("EACH").is_some() {
                for r in &rows { println!("      {} {:.3} {:.4}", group[0].name, r[1], r[2]); }
            }
            let [_, moving, still, seconds] = mean(&rows);
            line += &format!(" {moving:.4} {still:.4} {seconds:.1} |");
        }
        println!("{line}");
    }
    Ok(())
}
