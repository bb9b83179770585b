//! The linear model on the CPU. The formulas are in `field/linear.rs`.
//!
//! All sums are taken in an order that does not depend on the number of threads.

use std::sync::{Arc, OnceLock};

use rayon::prelude::*;

use super::model::Model;
use super::product_kernels::{Factors, ProductKernel};
use super::tile::{TILE, WorkingSets};
use super::variation::Variation;
use crate::flow::data::Point;
use crate::flow::field::{FittedField, LinearField, LinearGrid, Parameters, Placed};
use crate::flow::simd::Isa;

/// The three products with the encodings of the axes.
pub(super) struct Encoder {
    kernel: ProductKernel,
    threads: Arc<rayon::ThreadPool>,
    grid: LinearGrid,
    encodings: [Vec<f32>; 3],
}

impl Encoder {
    pub(super) fn new(isa: Isa, threads: Arc<rayon::ThreadPool>, grid: LinearGrid) -> Self {
        Self {
            kernel: ProductKernel::new(isa),
            threads,
            grid,
            encodings: [0, 1, 2].map(|axis| grid.encoding(axis)),
        }
    }

    /// `to = (phi_x (x) phi_y (x) phi_z) from`. The encodings are symmetric, so this is also the
    /// transposed product. `between` is overwritten.
    fn apply(&self, from: &[f32], to: &mut [f32], between: &mut [f32]) {
        let grid = &self.grid;
        let [x, y, z] = grid.vertices;
        let (row, plane, channel) = (grid.row(), grid.plane(), grid.channel());
        let [along_x, along_y, along_z] = &self.encodings;
        let across = |number: usize, out: &mut [f32], smoothed: &mut Vec<f32>| {
            let factors = Factors {
                a: &from[number * plane..(number + 1) * plane],
                a_row: row,
                b: along_x,
                b_row: row,
                rows: y,
                depth: x,
                columns: row,
            };
            self.kernel.multiply(factors, smoothed, row);
            let factors = Factors {
                a: along_y,
                a_row: along_y.len() / y,
                b: smoothed,
                b_row: row,
                rows: y,
                depth: y,
                columns: row,
            };
            self.kernel.multiply(factors, out, row);
        };
        let up = |number: usize, out: &mut [f32], between: &[f32]| {
            let (of, level) = (number / z, number % z);
            let stride = along_z.len() / z;
            let factors = Factors {
                a: &along_z[level * stride..],
                a_row: stride,
                b: &between[of * channel..(of + 1) * channel],
                b_row: plane,
                rows: 1,
                depth: z,
                columns: plane,
            };
            self.kernel.multiply(factors, out, plane);
        };
        self.threads.install(|| {
            let planes = between.par_chunks_mut(plane).enumerate();
            planes.for_each_init(
                || vec![0.0; plane],
                |smoothed, (number, out)| across(number, out, smoothed),
            );
            let planes = to.par_chunks_mut(plane).enumerate();
            planes.for_each(|(number, out)| up(number, out, between));
        });
    }
}

/// The linear model with the displacements of its current weights.
pub(super) struct Linear {
    encoder: Encoder,
    variation_weight: f32,
    /// Displacements of the vertices, metres.
    values: Vec<f32>,
    /// Derivatives of the loss with respect to them.
    value_gradients: Vec<f32>,
    between: Vec<f32>,
    variation: Variation,
    points: PlacedPoints,
    /// The field of the result, if it was computed since the last update.
    decoded: OnceLock<LinearField>,
}

/// The points of a batch on the grid.
#[derive(Default)]
struct PlacedPoints {
    placed: Vec<Placed>,
    /// Voxel and position of each, see [`LinearGrid::by_voxel`].
    by_voxel: Vec<[u32; 2]>,
}

impl Linear {
    /// The model on the grid of `encoder`, with the weight of the total variation in the loss.
    pub(super) fn new(encoder: Encoder, variation_weight: f32) -> Self {
        let floats = 3 * encoder.grid.channel();
        Self {
            encoder,
            variation_weight,
            values: vec![0.0; floats],
            value_gradients: vec![0.0; floats],
            between: vec![0.0; floats],
            variation: Variation::new(floats),
            points: PlacedPoints::default(),
            decoded: OnceLock::new(),
        }
    }

    /// The weight of the total variation in the loss over the number of vertices that it is a mean
    /// of.
    fn variation_share(&self) -> f32 {
        self.encoder.grid.variation_share(self.variation_weight)
    }

    /// The derivative of the loss with respect to the displacements of one level of vertices.
    fn level_gradient(&self, number: usize, flow_gradients: &[Point], out: &mut [f32]) {
        let grid = &self.encoder.grid;
        let (row, [_, _, z]) = (grid.row(), grid.vertices);
        let (channel, level) = (number / z, number % z);
        out.fill(0.0);
        let points = &self.points;
        // Points of the voxels above this level, then of those below it.
        for (below, cell) in [Some(level), level.checked_sub(1)].into_iter().enumerate() {
            let Some(cell) = cell else {
                continue;
            };
            let first = |level: usize| {
                let voxel = level as u32 * grid.voxels_of_a_level();
                points.by_voxel.partition_point(|&[of, _]| of < voxel)
            };
            for &[_, position] in &points.by_voxel[first(cell)..first(cell + 1)] {
                let Placed { cell, weights } = points.placed[position as usize];
                let [wx, wy, wz] = weights;
                let pull = wz[below] * flow_gradients[position as usize][channel];
                let first = cell[1] as usize * row + cell[0] as usize;
                for (across, wy) in wy.into_iter().enumerate() {
                    let at = first + across * row;
                    out[at] += wy * wx[0] * pull;
                    out[at + 1] += wy * wx[1] * pull;
                }
            }
        }
        if self.variation_weight == 0.0 {
            return;
        }
        let weight = self.variation_share();
        self.variation
            .add_gradient(grid, &self.values, number, weight, out);
    }
}

impl Model for Linear {
    type Output = Point;
    type WorkingSet = [Point; TILE];
    /// Derivatives with respect to the flows of the chunk's points.
    type ChunkGradients = Vec<Point>;
    const HELD: usize = usize::MAX;

    fn working_set(&self) -> Self::WorkingSet {
        [[0.0; 3]; TILE]
    }

    fn update(&mut self, parameters: &Parameters) {
        self.decoded = OnceLock::new();
        let weights = &parameters.as_slice()[..self.values.len()];
        self.encoder
            .apply(weights, &mut self.values, &mut self.between);
        if self.variation_weight > 0.0 {
            let (grid, threads) = (&self.encoder.grid, &self.encoder.threads);
            let (values, between) = (&self.values, &mut self.between);
            self.variation.measure(grid, values, between, threads);
        }
    }

    fn place(&mut self, points: &[Point]) {
        let grid = &self.encoder.grid;
        let placed = || points.par_iter().map(|&point| grid.place(point)).collect();
        let placed: Vec<Placed> = self.encoder.threads.install(placed);
        self.points = PlacedPoints {
            by_voxel: grid.by_voxel(&placed, 0..placed.len()),
            placed,
        };
    }

    fn forward<'a>(
        &self,
        _: &Parameters,
        points: &[Point],
        index: usize,
        flow: &'a mut Self::WorkingSet,
    ) -> &'a [Point] {
        let placed = &self.points.placed[index..index + points.len()];
        for (flow, placed) in flow.iter_mut().zip(placed) {
            *flow = placed.blend(&self.encoder.grid, &self.values);
        }
        &flow[..points.len()]
    }

    fn regularization(&self) -> f32 {
        self.variation_share() * self.variation.sum
    }

    fn chunk_gradients(&self) -> Self::ChunkGradients {
        Vec::new()
    }

    fn clear(&self, chunk: &mut Self::ChunkGradients) {
        chunk.clear();
    }

    fn backward(
        &self,
        _: &Parameters,
        output_gradients: &[Point],
        _: &mut Self::WorkingSet,
        chunk: &mut Self::ChunkGradients,
    ) {
        chunk.extend_from_slice(output_gradients);
    }

    fn add_to_the_first(&self, _: &mut [Self::ChunkGradients]) {
        unreachable!("all chunks are held");
    }

    fn gradient(&mut self, chunks: &[Self::ChunkGradients], gradients: &mut Parameters) {
        let flow_gradients = chunks.concat();
        let mut value_gradients = core::mem::take(&mut self.value_gradients);
        self.encoder.threads.install(|| {
            let levels = value_gradients.par_chunks_mut(self.encoder.grid.plane());
            levels
                .enumerate()
                .for_each(|(number, out)| self.level_gradient(number, &flow_gradients, out));
        });
        let gradients = &mut gradients.as_mut_slice()[..value_gradients.len()];
        self.encoder
            .apply(&value_gradients, gradients, &mut self.between);
        self.value_gradients = value_gradients;
    }

    fn evaluate(
        &self,
        parameters: &Parameters,
        points: &[Point],
        _: &WorkingSets<Self::WorkingSet>,
    ) -> Vec<Point> {
        self.decoded(parameters).flow(points, &self.encoder.threads)
    }

    fn fitted(&self, parameters: &Parameters) -> FittedField {
        FittedField::Linear(self.decoded(parameters).clone())
    }
}

impl Linear {
    /// The field of the result, whose parameters are `parameters`.
    fn decoded(&self, parameters: &Parameters) -> &LinearField {
        self.decoded.get_or_init(|| self.field(parameters))
    }

    /// The field with `parameters`.
    fn field(&self, parameters: &Parameters) -> LinearField {
        let mut values = vec![0.0; self.values.len()];
        let mut between = vec![0.0; self.values.len()];
        let weights = &parameters.as_slice()[..values.len()];
        self.encoder.apply(weights, &mut values, &mut between);
        LinearField {
            grid: self.encoder.grid,
            values,
        }
    }
}

#[cfg(test)]
mod tests;
