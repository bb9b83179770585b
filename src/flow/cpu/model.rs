//! The models that the CPU can fit: the flow of points as a function of parameters.

use rayon::prelude::*;

use super::tile::{TILE, WorkingSets};
use crate::flow::data::Point;
use crate::flow::field::{FittedField, Output, Parameters};

/// A model that a field can be fitted with. It computes tiles of up to [`TILE`]
/// points, each in the working set of one thread. Tiles add up to chunks.
pub(super) trait Model: Send + Sync {
    /// What it computes for a point.
    type Output: Output;
    /// The working set of one thread.
    type WorkingSet: Send;
    /// What [`Self::backward`] keeps of the tiles of one chunk.
    type ChunkGradients: Send;
    /// Chunks that are held in memory at once. If a batch has more, the held ones are summed into
    /// the first.
    const HELD: usize;

    /// A new working set.
    fn working_set(&self) -> Self::WorkingSet;

    /// Updates what the model derives from its parameters. Called before the first iteration and
    /// after every change of `parameters` or of those of the result.
    fn update(&mut self, parameters: &Parameters);

    /// Prepares the points of the following iterations. Called before the first iteration, and
    /// where the points change.
    fn place(&mut self, _points: &[Point]) {}

    /// The output at each point. Keeps what [`Self::backward`] needs in `working_set`. The
    /// points begin at `index` of those of the last [`Self::place`], and the parameters are those
    /// of the last [`Self::update`].
    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        index: usize,
        working_set: &'a mut Self::WorkingSet,
    ) -> &'a [Self::Output];

    /// What the model adds to the mean loss of the points.
    fn regularization(&self) -> f32 {
        0.0
    }

    /// The gradients of a chunk without points.
    fn chunk_gradients(&self) -> Self::ChunkGradients;

    /// Empties the gradients of a chunk.
    fn clear(&self, chunk: &mut Self::ChunkGradients);

    /// Adds a tile to its chunk. `output_gradients` are the derivatives of the loss with respect to
    /// the outputs of the last [`Self::forward`].
    fn backward(
        &self,
        parameters: &Parameters,
        output_gradients: &[Self::Output],
        working_set: &mut Self::WorkingSet,
        chunk: &mut Self::ChunkGradients,
    );

    /// Adds the gradients of all other chunks to those of the first, in order.
    fn add_to_the_first(&self, chunks: &mut [Self::ChunkGradients]);

    /// The derivatives of the loss with respect to the parameters, from all chunks in order, with
    /// those of the regularization.
    fn gradient(&mut self, chunks: &[Self::ChunkGradients], gradients: &mut Parameters);

    /// The field with `parameters`: those of the result at the last [`Self::update`], which may be
    /// others than those of that call.
    fn fitted(&self, parameters: &Parameters) -> FittedField;

    /// The flow of that field at any N `points`, N x 3 displacements in metres.
    fn evaluate(
        &self,
        parameters: &Parameters,
        points: &[Point],
        working_sets: &WorkingSets<Self::WorkingSet>,
    ) -> Vec<Point>;
}

/// The output at each of the N `points`. They are the points of the model's last [`Model::place`],
/// and `parameters` those of its last [`Model::update`].
pub(super) fn forward<M: Model>(
    model: &M,
    parameters: &Parameters,
    threads: &rayon::ThreadPool,
    working_sets: &WorkingSets<M::WorkingSet>,
    points: &[Point],
) -> Vec<M::Output> {
    by_tiles(
        threads,
        working_sets,
        points,
        |points, index, working_set, outputs| {
            outputs.copy_from_slice(model.forward(parameters, points, index, working_set));
        },
    )
}

/// One output for each of `points`. `compute` writes those of a tile, which begins at the given
/// index, with the working set of its thread.
pub(super) fn by_tiles<W: Send, O: Output>(
    threads: &rayon::ThreadPool,
    working_sets: &WorkingSets<W>,
    points: &[Point],
    compute: impl Fn(&[Point], usize, &mut W, &mut [O]) + Sync,
) -> Vec<O> {
    let mut outputs = vec![O::default(); points.len()];
    threads.install(|| {
        let tiles = outputs.par_chunks_mut(TILE).zip(points.par_chunks(TILE));
        tiles.enumerate().for_each(|(tile, (outputs, points))| {
            compute(points, tile * TILE, &mut working_sets.own(), outputs);
        });
    });
    outputs
}
