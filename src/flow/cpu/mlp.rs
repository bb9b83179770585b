//! The coordinate network as a model of the CPU, and what it shares with a pair of networks.

use std::sync::Arc;

use rayon::prelude::*;

use super::kernels::Kernels;
use super::model::{Model, by_tiles};
use super::tile::{Tile, WorkingSets};
use crate::flow::data::Point;
use crate::flow::field::{
    Conditioning, FittedField, Network, Parameters, WIDTH, first_layer, last_layer, mlp,
    transpose_middle_layers,
};

/// Parameters that one thread sums at a time.
const SLICE: usize = 4096;
/// Chunks of gradients that are held in memory at once.
pub(super) const HELD: usize = 32;

/// The kernels of a network, with the normalization of its inputs.
#[derive(Clone, Copy)]
pub(super) struct Pass {
    pub(super) kernels: Kernels,
    pub(super) conditioning: Conditioning,
    /// Bird's eye view: the flow has no z. The points have z = 0.
    pub(super) flat: bool,
}

impl Pass {
    /// The flow of each point, by the network with `parameters`. Keeps the activations in `tile`.
    pub(super) fn forward<'a>(
        &self,
        parameters: &[f32],
        points: impl ExactSizeIterator<Item = Point>,
        tile: &'a mut Tile,
    ) -> &'a [Point] {
        let rows = points.len();
        tile.load(points.map(|point| self.conditioning.apply(point)));
        self.kernels.forward(parameters, tile);
        if self.flat {
            tile.outputs.iter_mut().for_each(|flow| flow[2] = 0.0);
        }
        &tile.outputs[..rows]
    }

    /// Adds the gradients of a tile to `gradients`, from its `output_gradients`. `transposed` are
    /// the transposed weights of `parameters`.
    pub(super) fn backward(
        &self,
        parameters: &[f32],
        transposed: &[f32],
        tile: &mut Tile,
        gradients: &mut [f32],
    ) {
        if self.flat {
            let rows = tile.output_gradients.iter_mut();
            rows.for_each(|gradient| gradient[2] = 0.0);
        }
        self.kernels
            .backward(parameters, transposed, tile, gradients);
    }

    /// The network with `parameters`. A flat one has no weights for z, so its flow does not depend
    /// on it.
    pub(super) fn fitted(&self, parameters: &[f32]) -> FittedField {
        let mut network = mlp::zeros();
        let floats = network.as_mut_slice();
        floats.copy_from_slice(parameters);
        if self.flat {
            let (first, last) = (first_layer(), last_layer());
            floats[first.weights + 2 * WIDTH..][..WIDTH].fill(0.0);
            floats[last.weights + 2 * WIDTH..][..WIDTH].fill(0.0);
            floats[last.bias + 2] = 0.0;
        }
        FittedField::Network(Network {
            parameters: network,
            conditioning: self.conditioning,
        })
    }

    /// The flow of the network with `parameters` at any N `points`, N x 3 displacements in metres.
    /// `tile` is the one that a working set lends.
    pub(super) fn evaluate<W: Send>(
        &self,
        parameters: &[f32],
        points: &[Point],
        threads: &rayon::ThreadPool,
        working_sets: &WorkingSets<W>,
        tile: impl Fn(&mut W) -> &mut Tile + Sync,
    ) -> Vec<Point> {
        by_tiles(
            threads,
            working_sets,
            points,
            |points, _, working_set, flows| {
                let points = points.iter().copied();
                flows.copy_from_slice(self.forward(parameters, points, tile(working_set)));
            },
        )
    }
}

/// The coordinate network of FNSF, Section 3.
pub(super) struct Mlp {
    pass: Pass,
    threads: Arc<rayon::ThreadPool>,
    /// The transposed weights of the middle layers.
    transposed: Parameters,
}

impl Mlp {
    pub(super) fn new(pass: Pass, threads: Arc<rayon::ThreadPool>) -> Self {
        Self {
            pass,
            threads,
            transposed: mlp::zeros(),
        }
    }
}

impl Model for Mlp {
    type Output = Point;
    type WorkingSet = Tile;
    type ChunkGradients = Parameters;
    const HELD: usize = HELD;

    fn working_set(&self) -> Tile {
        Tile::new()
    }

    fn update(&mut self, parameters: &Parameters) {
        transpose_middle_layers(parameters.as_slice(), self.transposed.as_mut_slice());
    }

    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        _: usize,
        tile: &'a mut Tile,
    ) -> &'a [Point] {
        let points = points.iter().copied();
        self.pass.forward(parameters.as_slice(), points, tile)
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
        output_gradients: &[Point],
        tile: &mut Tile,
        chunk: &mut Parameters,
    ) {
        tile.output_gradients[..output_gradients.len()].copy_from_slice(output_gradients);
        let (parameters, transposed) = (parameters.as_slice(), self.transposed.as_slice());
        let chunk = chunk.as_mut_slice();
        self.pass.backward(parameters, transposed, tile, chunk);
    }

    fn add_to_the_first(&self, chunks: &mut [Parameters]) {
        add_to_the_first(&self.threads, chunks);
    }

    fn gradient(&mut self, chunks: &[Parameters], gradients: &mut Parameters) {
        sum(&self.threads, chunks, gradients);
    }

    fn fitted(&self, parameters: &Parameters) -> FittedField {
        self.pass.fitted(parameters.as_slice())
    }

    fn evaluate(
        &self,
        parameters: &Parameters,
        points: &[Point],
        working_sets: &WorkingSets<Tile>,
    ) -> Vec<Point> {
        let (pass, parameters) = (&self.pass, parameters.as_slice());
        pass.evaluate(parameters, points, &self.threads, working_sets, |tile| tile)
    }
}

/// Adds all other chunks to the first, in order.
pub(super) fn add_to_the_first(threads: &rayon::ThreadPool, chunks: &mut [Parameters]) {
    if let [first, others @ ..] = chunks {
        let slices = first.as_mut_slice().par_chunks_mut(SLICE).enumerate();
        threads.install(|| slices.for_each(|(slice, sums)| add_slices(sums, others, slice)));
    }
}

/// The sum of the chunks, in order.
pub(super) fn sum(threads: &rayon::ThreadPool, chunks: &[Parameters], gradients: &mut Parameters) {
    let slices = gradients.as_mut_slice().par_chunks_mut(SLICE).enumerate();
    threads.install(|| {
        slices.for_each(|(slice, sums)| {
            sums.fill(0.0);
            add_slices(sums, chunks, slice);
        });
    });
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
