//! Evaluation of a fitted network at given points, in parallel tiles.

use rayon::prelude::*;

use super::kernels::Kernels;
use super::tile::{TILE, WorkingSets};
use crate::flow::data::Point;
use crate::flow::field::{Conditioning, Parameters};

/// The flow at each of the N `points`, N x 3 displacements in metres.
pub(super) fn evaluate(
    kernels: &Kernels,
    threads: &rayon::ThreadPool,
    working_sets: &WorkingSets,
    (parameters, conditioning): (&Parameters, &Conditioning),
    points: &[Point],
) -> Vec<Point> {
    let mut flow = vec![[0.0; 3]; points.len()];
    threads.install(|| {
        flow.par_chunks_mut(TILE)
            .zip(points.par_chunks(TILE))
            .for_each(|(flow, points)| {
                let mut tile = working_sets.own();
                tile.load(points.iter().map(|&point| conditioning.apply(point)));
                kernels.forward(parameters, &mut tile);
                flow.copy_from_slice(&tile.outputs[..points.len()]);
            });
    });
    flow
}
