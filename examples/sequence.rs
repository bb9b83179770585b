//! A sequence: sweeps come in one by one, each pair's flow goes out as soon as it is known.
//!
//! ```text
//! cargo run --release --example sequence
//! ```
#![expect(clippy::print_stdout, reason = "the results are printed")]

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{Estimate, Preset, Sequence, Sweep, Uncontrolled};

/// Sweeps of the simulated drive.
const SWEEPS: usize = 5;

fn main() -> anyhow::Result<()> {
    let street = Street::new(&StreetOptions {
        sweeps: SWEEPS,
        ..StreetOptions::default()
    })?;
    let backend = CpuBackend::new(None)?;
    // `label` looks at several sweeps around each pair, so flows come one or more sweeps later.
    let options = Preset::Label.options(None);
    let mut sequence = Sequence::default();
    let mut estimates: Vec<Estimate> = Vec::new();
    for index in 0..SWEEPS {
        let sweep = Sweep {
            points: street.sweep(index)?.points,
            ground: None,
            ..Sweep::default()
        };
        let new = sequence.push(&backend, sweep, &options, &Uncontrolled)?;
        println!("sweep {index}: {} flows", new.len());
        estimates.extend(new);
    }
    loop {
        let last = sequence.finish(&backend, &Uncontrolled)?;
        if last.is_empty() {
            break;
        }
        estimates.extend(last);
    }
    for (index, estimate) in estimates.iter().enumerate() {
        let clusters = estimate.objects().map_or(0, |found| found.clusters.len());
        println!(
            "pair {index}: {clusters} clusters, ego motion {:?}",
            estimate.ego
        );
    }
    Ok(())
}
