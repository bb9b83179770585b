//! Depth of a simulated street from one sweep and from several: rows of `docs/experiments/densify.md`.
//!
//! Static points of other sweeps are transformed by the true poses. The result therefore measures
//! the projection and its occlusion filter, and not the flow. With an argument, a picture is
//! written to that file.

use super::camera::{camera, depth_row};
use fnsf::flow::Point;
use fnsf::flow::depth::{Occlusion, project};
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::picture::{DepthPanel, depth_panels, write_png};
use nalgebra::Point3;

const SWEEPS: [usize; 4] = [1, 3, 10, 20];
const SEEDS: u64 = 4;
/// Number of sweeps that the picture shows.
const SHOWN: usize = 10;

pub(super) fn run(arguments: &[String]) -> anyhow::Result<()> {
    let camera = camera()?;
    println!("| sweeps | filter | pixels | mean error, m | RMSE, m | within 5 % |");
    println!("|---|---|---|---|---|---|");
    let mut pictures = Vec::new();
    for sweeps in SWEEPS {
        for filtered in [false, true] {
            let mut sums = [0.0; 4];
            for seed in 0..SEEDS {
                let street = Street::new(&StreetOptions {
                    seed,
                    // One sweep more than is used, so that every used sweep has a pair with dynamic
                    // flags.
                    sweeps: sweeps + 1,
                    ..StreetOptions::default()
                })?;
                let into = sweeps / 2;
                let truth = street.depth(into, &camera)?;
                let mut image = project(&static_world(&street, into)?, &camera);
                if filtered {
                    image = image.without_occluded(&Occlusion::of(&camera));
                }
                let row = depth_row(&image, &truth)?;
                for (sum, value) in sums.iter_mut().zip(row) {
                    *sum += value / SEEDS as f64;
                }
                if seed == 0 && sweeps == SHOWN && filtered {
                    let one = project(&street.sweep(into)?.points, &camera);
                    let all = project(&static_world(&street, into)?, &camera);
                    pictures = vec![one, all, image, truth];
                }
            }
            let [density, mean, rmse, within] = sums;
            let filter = if filtered { "on" } else { "off" };
            println!(
                "| {sweeps} | {filter} | {:.1} % | {mean:.2} | {rmse:.2} | {:.1} % |",
                100.0 * density,
                100.0 * within
            );
        }
    }
    if let Some(path) = arguments.first() {
        let panel = |(title, image)| DepthPanel { title, image };
        let titles = ["1 sweep", "10 sweeps", "10 sweeps, filtered", "truth"];
        let panels: Vec<DepthPanel<'_>> = titles.into_iter().zip(&pictures).map(panel).collect();
        write_png(&depth_panels(&panels), &mut std::fs::File::create(path)?)?;
    }
    Ok(())
}

/// All points of one sweep, and the static points of all others, in the frame of that sweep.
fn static_world(street: &Street, into: usize) -> anyhow::Result<Vec<Point>> {
    let target = street.sweep(into)?;
    let mut points = Vec::new();
    for index in 0..street.sweeps() - 1 {
        let frame = street.sweep(index)?;
        let motion = target.world_from_sensor.inv_mul(&frame.world_from_sensor);
        let dynamic = street.pair(index)?.dynamic;
        for (point, dynamic) in frame.points.iter().zip(dynamic) {
            if index == into || !dynamic {
                let there = motion * Point3::from(point.map(f64::from));
                points.push([there.x as f32, there.y as f32, there.z as f32]);
            }
        }
    }
    Ok(points)
}
