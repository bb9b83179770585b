//! The forward pass of a model over many points, in parallel tiles.

use rayon::prelude::*;

use super::model::Model;
use super::tile::{TILE, WorkingSets};
use crate::flow::data::Point;
use crate::flow::field::Parameters;

/// The flow at each of the N `points`, N x 3 displacements in metres. They are the points of the
/// model's last [`Model::place`], and `parameters` those of its last [`Model::update`].
pub(super) fn forward<M: Model>(
    model: &M,
    parameters: &Parameters,
    threads: &rayon::ThreadPool,
    working_sets: &WorkingSets<M::WorkingSet>,
    points: &[Point],
) -> Vec<Point> {
    let mut flow = vec![[0.0; 3]; points.len()];
    threads.install(|| {
        flow.par_chunks_mut(TILE)
            .zip(points.par_chunks(TILE))
            .enumerate()
            .for_each(|(tile, (flow, points))| {
                let mut working_set = working_sets.own();
                let index = tile * TILE;
                flow.copy_from_slice(model.forward(parameters, points, index, &mut working_set));
            });
    });
    flow
}
