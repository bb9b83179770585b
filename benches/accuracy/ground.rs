//! Accuracy of the ground segmentation on real and simulated sweeps: rows of `docs/experiments/ground.md`.
//!
//! `FNSF_REAL_DATA` names the folder of the real pairs. Without it only simulated streets are used.

use std::path::PathBuf;
use std::time::Instant;

use fnsf::flow::Point;
use fnsf::flow::ground::{GroundOptions, segment};
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::formats::read_pair;

/// Runs per sweep. The fastest one is reported, because the machine may have other load.
const RUNS: usize = 7;

type Sweep = (Vec<Point>, Vec<bool>);

pub(super) fn run() -> anyhow::Result<()> {
    println!("| sweeps | points | precision | recall | 35 to 80 m | origin above ground, m | ms |");
    println!("|---|---|---|---|---|---|---|");
    if let Some(folder) = std::env::var_os("FNSF_REAL_DATA").map(PathBuf::from) {
        for name in ["av2_7fab", "kitti_0000", "small_gicp"] {
            let bytes = std::fs::read(folder.join(name).join("pair.npz"))?;
            let pair = read_pair(&bytes)?;
            let ground = pair.ground.unwrap_or_default();
            row(&format!("{name}, first"), &[(pair.source, ground.source)]);
            row(&format!("{name}, second"), &[(pair.target, ground.target)]);
        }
    }
    for (beams, azimuth_steps) in [(16, 1800), (32, 1800), (64, 2000), (128, 1024)] {
        let street = |seed| {
            let frame = Street::new(&StreetOptions {
                seed,
                beams,
                azimuth_steps,
                ..StreetOptions::default()
            })?
            .sweep(0)?;
            anyhow::Ok((frame.points, frame.ground))
        };
        let sweeps = (0..6).map(street).collect::<Result<Vec<_>, _>>()?;
        row(&format!("{beams} beams, seeds 0 to 5"), &sweeps);
    }
    Ok(())
}

/// Prints one row: the worst figures over the sweeps.
fn row(name: &str, sweeps: &[Sweep]) {
    let options = GroundOptions::default();
    let mut worst = [[f64::INFINITY; 2]; 2];
    let mut heights = [f32::INFINITY, f32::NEG_INFINITY];
    let [mut points_seen, mut slowest] = [0, 0];
    for (points, labels) in sweeps {
        let mut fastest = u128::MAX;
        let mut found = segment(points, &options);
        for _ in 0..RUNS {
            let start = Instant::now();
            found = segment(points, &options);
            fastest = fastest.min(start.elapsed().as_micros());
        }
        slowest = slowest.max(fastest as usize);
        points_seen = points_seen.max(points.len());
        let height = found.origin_height_m.unwrap_or(f32::NAN);
        heights = [heights[0].min(height), heights[1].max(height)];
        for (worst, range) in worst.iter_mut().zip([0.0..35.0, 35.0..80.0]) {
            let near = |point: &Point| range.contains(&point[0].hypot(point[1]));
            let rows = points.iter().zip(&found.ground).zip(labels);
            let mut counts = [0.0; 3];
            for ((_, &found), &label) in rows.filter(|((point, _), _)| near(point)) {
                counts[0] += f64::from(u8::from(found && label));
                counts[1] += f64::from(u8::from(found));
                counts[2] += f64::from(u8::from(label));
            }
            worst[0] = worst[0].min(counts[0] / counts[1]);
            worst[1] = worst[1].min(counts[0] / counts[2]);
        }
    }
    println!(
        "| {name} | {points_seen} | {:.3} | {:.3} | {:.2}, {:.2} | {:.2} to {:.2} | {:.1} |",
        worst[0][0],
        worst[0][1],
        worst[1][0],
        worst[1][1],
        heights[0],
        heights[1],
        slowest as f64 / 1000.0
    );
}
