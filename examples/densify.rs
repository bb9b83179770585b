//! Densification: all sweeps of a simulated drive in one cloud at the time of the middle one.
//!
//! ```text
//! cargo run --release --example densify -- dense.ply
//! ```
#![expect(clippy::print_stdout, reason = "the result is printed")]

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::densify::{LaterSweeps, Plan, densify};
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{Preset, Problem, Sweep, Uncontrolled, estimate};
use fnsf::formats::{DenseFormat, write_dense};

/// Sweeps of the simulated drive.
const SWEEPS: usize = 5;

fn main() -> anyhow::Result<()> {
    let path = std::env::args()
        .nth(1)
        .unwrap_or_else(|| "dense.ply".to_owned());
    let street = Street::new(&StreetOptions {
        sweeps: SWEEPS,
        ..StreetOptions::default()
    })?;
    let backend = CpuBackend::new(None)?;
    let options = Preset::Default.options(None);
    let sweeps = (0..SWEEPS).map(|index| -> anyhow::Result<Sweep> {
        let points = street.sweep(index)?.points;
        let ground = None;
        Ok(Sweep {
            points,
            ground,
            ..Sweep::default()
        }
        .prepared(&options))
    });
    let sweeps: Vec<Sweep> = sweeps.collect::<Result<_, _>>()?;

    // The plan says which pairs need a flow: forward before the reference time, backward after it.
    let plan = Plan::new(SWEEPS, 2.0, LaterSweeps::Reverse, 1)?;
    let mut fields = BTreeMap::new();
    for edge in plan.edges() {
        let [source, target] = [&sweeps[edge.source], &sweeps[edge.target]];
        let problem = Problem {
            ground: source
                .ground
                .as_deref()
                .zip(target.ground.as_deref())
                .map(<[_; 2]>::from),
            ..Problem::pair(&source.points, &target.points)
        };
        let estimate = estimate(&backend, &problem, &options, &Uncontrolled)?;
        fields.insert(edge, estimate.motion);
    }
    let field = |edge| fields.get(&edge);
    let cloud = densify(&backend, &plan, &sweeps, field, &Uncontrolled)?;
    println!(
        "{} points of {SWEEPS} sweeps at the time of sweep 2",
        cloud.points.len()
    );

    let mut file = BufWriter::new(File::create(&path)?);
    write_dense(
        DenseFormat::from_path(Path::new(&path))?,
        &cloud,
        None,
        &mut file,
    )?;
    Ok(())
}
