//! The flow of a pair: two cloud files in, the motion of every point of the first one out.
//!
//! ```text
//! cargo run --release --example pair -- first.pcd second.pcd flow.ply
//! ```
#![expect(clippy::print_stdout, reason = "the result is printed")]

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::Context;
use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::{Preset, Problem, Uncontrolled, estimate};
use fnsf::formats::{FlowFormat, FlowTable, read_cloud, write_flow};

fn main() -> anyhow::Result<()> {
    let files: Vec<String> = std::env::args().skip(1).collect();
    let [source, target, output] = files.as_slice() else {
        anyhow::bail!("usage: pair SOURCE TARGET OUTPUT");
    };
    let read = |path: &String| -> anyhow::Result<_> {
        let bytes = std::fs::read(path).with_context(|| path.clone())?;
        // The name decides only where the content does not.
        Ok(read_cloud(&bytes, Some(path))?.points)
    };
    let (source, target) = (read(source)?, read(target)?);

    // All threads of this machine. The options have no ground mask, so the ground is segmented.
    let backend = CpuBackend::new(None)?;
    let options = Preset::Default.options(None);
    let problem = Problem::pair(&source, &target);
    let estimate = estimate(&backend, &problem, &options, &Uncontrolled)?;

    // N x 3 displacements in metres: where a point is in the target's frame, minus where it was.
    let moving = estimate.dynamic.iter().flatten().filter(|&&moves| moves);
    println!(
        "{} of {} points have a flow, {} move",
        estimate.points,
        source.len(),
        moving.count()
    );
    for cluster in estimate.objects().iter().flat_map(|found| &found.clusters) {
        println!("cluster {cluster:?}");
    }

    let table = FlowTable {
        source: &source,
        flow: &estimate.flow,
        valid: &estimate.valid,
        dynamic: estimate.dynamic.as_deref(),
        objects: estimate.objects(),
        ego: estimate.ego.as_ref(),
    };
    let format = FlowFormat::from_path(Path::new(output))?;
    let mut file = BufWriter::new(File::create(output)?);
    write_flow(format, &table, &mut file)?;
    Ok(())
}
