//! The models that the CPU can fit: the flow of points as a function of parameters.

use std::sync::Arc;

use rayon::prelude::*;

use super::kernels::Kernels;
use super::tile::{TILE, Tile, WorkingSets};
use crate::flow::data::Point;
use crate::flow::field::{
    Conditioning, FittedField, Network, Parameters, mlp, transpose_middle_layers,
};

/// Parameters that one thread sums at a time.
const SLICE: usize = 4096;

/// A model that a field can be fitted with. It computes tiles of up to [`TILE`]
/// points, each in the working set of one thread. Tiles add up to chunks.
pub(super) trait Model: Send + Sync {
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
    /// after every change of `parameters`.
    fn update(&mut self, parameters: &Parameters);

    /// Prepares the points of the following iterations. Called before the first iteration, and
    /// where the points change.
    fn place(&mut self, _points: &[Point]) {}

    /// The flow of each point, metres. Keeps what [`Self::backward`] needs in `working_set`. The
    /// points begin at `index` of those of the last [`Self::place`], and the parameters are those
    /// of the last [`Self::update`].
    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        index: usize,
        working_set: &'a mut Self::WorkingSet,
    ) -> &'a [Point];

    /// What the model adds to the mean loss of the points.
    fn regularization(&self) -> f32 {
        0.0
    }

    /// The gradients of a chunk without points.
    fn chunk_gradients(&self) -> Self::ChunkGradients;

    /// Empties the gradients of a chunk.
    fn clear(&self, chunk: &mut Self::ChunkGradients);

    /// Adds a tile to its chunk. `flow_gradients` are the derivatives of the loss with respect to
    /// the flows of the last [`Self::forward`].
    fn backward(
        &self,
        parameters: &Parameters,
        flow_gradients: &[Point],
        working_set: &mut Self::WorkingSet,
        chunk: &mut Self::ChunkGradients,
    );

    /// Adds the gradients of all other chunks to those of the first, in order.
    fn add_to_the_first(&self, chunks: &mut [Self::ChunkGradients]);

    /// The derivatives of the loss with respect to the parameters, from all chunks in order, with
    /// those of the regularization.
    fn gradient(&mut self, chunks: &[Self::ChunkGradients], gradients: &mut Parameters);

    /// The field with `parameters`, which may be others than those of the last [`Self::update`].
    fn fitted(&self, parameters: &Parameters) -> FittedField;

    /// The flow of that field at any N `points`, N x 3 displacements in metres.
    fn evaluate(
        &self,
        parameters: &Parameters,
        points: &[Point],
        working_sets: &WorkingSets<Self::WorkingSet>,
    ) -> Vec<Point>;
}

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

/// The coordinate network of FNSF, Section 3.
pub(super) struct Mlp {
    kernels: Kernels,
    threads: Arc<rayon::ThreadPool>,
    conditioning: Conditioning,
    /// The transposed weights of the middle layers.
    transposed: Parameters,
}

impl Mlp {
    pub(super) fn new(
        kernels: Kernels,
        threads: Arc<rayon::ThreadPool>,
        conditioning: Conditioning,
    ) -> Self {
        Self {
            kernels,
            threads,
            conditioning,
            transposed: mlp::zeros(),
        }
    }
}

impl Model for Mlp {
    type WorkingSet = Tile;
    type ChunkGradients = Parameters;
    const HELD: usize = 32;

    fn working_set(&self) -> Tile {
        Tile::new()
    }

    fn update(&mut self, parameters: &Parameters) {
        transpose_middle_layers(parameters, &mut self.transposed);
    }

    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        _: usize,
        tile: &'a mut Tile,
    ) -> &'a [Point] {
        tile.load(points.iter().map(|&point| self.conditioning.apply(point)));
        self.kernels.forward(parameters, tile);
        &tile.outputs[..points.len()]
    }

    fn chunk_gradients(&self) -> Parameters {
        mlp::zeros()
    }

    fn clear(&self, chunk: &mut Parameters) {
        chunk.as_mut_slice().fill(0.0);
    }

    fn backward(
        &self,
        parameters: &Parameters,
        flow_gradients: &[Point],
        tile: &mut Tile,
        chunk: &mut Parameters,
    ) {
        tile.output_gradients[..flow_gradients.len()].copy_from_slice(flow_gradients);
        self.kernels
            .backward(parameters, &self.transposed, tile, chunk);
    }

    fn add_to_the_first(&self, chunks: &mut [Parameters]) {
        if let [first, others @ ..] = chunks {
            let slices = first.as_mut_slice().par_chunks_mut(SLICE).enumerate();
            self.threads
                .install(|| slices.for_each(|(slice, sums)| add_slices(sums, others, slice)));
        }
    }

    fn gradient(&mut self, chunks: &[Parameters], gradients: &mut Parameters) {
        let slices = gradients.as_mut_slice().par_chunks_mut(SLICE).enumerate();
        self.threads.install(|| {
            slices.for_each(|(slice, sums)| {
                sums.fill(0.0);
                add_slices(sums, chunks, slice);
            });
        });
    }

    fn fitted(&self, parameters: &Parameters) -> FittedField {
        FittedField::Network(Network {
            parameters: parameters.clone(),
            conditioning: self.conditioning,
        })
    }

    fn evaluate(
        &self,
        parameters: &Parameters,
        points: &[Point],
        working_sets: &WorkingSets<Tile>,
    ) -> Vec<Point> {
        forward(self, parameters, &self.threads, working_sets, points)
    }
}

/// Adds one slice of each chunk's gradients to `sums`, in order.
fn add_slices(sums: &mut [f32], chunks: &[Parameters], slice: usize) {
    for chunk in chunks {
        let gradients = &chunk.as_slice()[slice * SLICE..];
        for (sum, gradient) in sums.iter_mut().zip(gradients) {
            *sum += gradient;
        }
    }
}
