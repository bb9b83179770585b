//! Overlap of pairs of one scene and of two scenes: rows of `docs/experiments/overlap.md`.
//!
//! `FNSF_REAL_DATA` names the folder of the real pairs. Without it only simulated streets are used.

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{LEAST_OVERLAP, Options, Point, Preset, Problem, Uncontrolled, estimate};

use super::labelled::{LabelledPair, real_pairs};

/// The first of the seeds, none of which any option was tuned on.
const FIRST_SEED: u64 = 300;
/// A kind of pair.
struct Kind {
    name: &'static str,
    beams: usize,
    azimuth_steps: usize,
    /// Sweeps from the source to the target.
    later: usize,
    speed_mps: Option<f64>,
    seeds: u64,
}

const fn kind(name: &'static str, beams: usize, later: usize, seeds: u64) -> Kind {
    Kind {
        name,
        beams,
        azimuth_steps: if beams == 64 { 2000 } else { 1080 },
        later,
        speed_mps: None,
        seeds,
    }
}

const KINDS: [Kind; 6] = [
    kind("64 beams", 64, 1, 200),
    kind("64 beams, 0.5 s", 64, 5, 20),
    Kind {
        speed_mps: Some(30.0),
        ..kind("64 beams, 0.2 s at 30 m/s", 64, 2, 20)
    },
    kind("32 beams", 32, 1, 20),
    kind("32 beams, 0.5 s", 32, 5, 20),
    kind("16 beams", 16, 1, 20),
];

pub(super) fn run() -> anyhow::Result<()> {
    println!(
        "| pairs | one scene: pairs | lowest | refused | two scenes: pairs | highest | refused |"
    );
    println!("|---|---|---|---|---|---|---|");
    for kind in KINDS {
        let pair = |seed: u64| {
            let street = Street::new(&StreetOptions {
                seed: FIRST_SEED + seed,
                beams: kind.beams,
                azimuth_steps: kind.azimuth_steps,
                speed_mps: kind.speed_mps,
                sweeps: kind.later + 1,
                ..StreetOptions::default()
            })?;
            anyhow::Ok([street.sweep(0)?.points, street.sweep(kind.later)?.points])
        };
        let [mut one, mut two] = [Vec::new(), Vec::new()];
        let mut before = pair(kind.seeds - 1)?;
        for seed in 0..kind.seeds {
            let [source, target] = pair(seed)?;
            one.push(overlap(&source, &target)?);
            two.push(overlap(&before[0], &target)?);
            before = [source, target];
        }
        row(kind.name, &one, &two);
    }
    let real: Vec<LabelledPair> = real_pairs().map_err(anyhow::Error::msg)?;
    let [mut one, mut two] = [Vec::new(), Vec::new()];
    for (i, first) in real.iter().enumerate() {
        for (j, second) in real.iter().enumerate() {
            let overlaps = if i == j { &mut one } else { &mut two };
            overlaps.push(overlap(&first.source, &second.target)?);
        }
    }
    if !real.is_empty() {
        row("labelled pairs, each with each", &one, &two);
    }
    Ok(())
}

/// Overlap after a registration.
fn overlap(source: &[Point], target: &[Point]) -> anyhow::Result<f32> {
    let mut options = Options {
        force: true,
        ..Preset::Neural.options(None)
    };
    if let Some(field) = options.field_mut() {
        field.max_iterations = 0;
    }
    let problem = Problem::pair(source, target);
    let estimate = estimate(&CpuBackend::new(None)?, &problem, &options, &Uncontrolled)?;
    estimate
        .overlap
        .ok_or_else(|| anyhow::anyhow!("the clouds are too small"))
}

fn row(name: &str, one: &[f32], two: &[f32]) {
    let refused = |overlaps: &[f32]| overlaps.iter().filter(|&&o| o < LEAST_OVERLAP).count();
    println!(
        "| {name} | {} | {:.3} | {} | {} | {:.3} | {} |",
        one.len(),
        one.iter().copied().fold(f32::INFINITY, f32::min),
        refused(one),
        two.len(),
        two.iter().copied().fold(0.0, f32::max),
        refused(two)
    );
}
