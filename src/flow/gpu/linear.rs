//! The linear model on the GPU. The formulas are in `field/linear.rs`.
//!
//! A fit has buffers of its own, in addition to the GPU's budget, and submissions of its own.

use std::sync::Arc;

use rayon::prelude::*;

use super::buffers::{Buffers, spread};
use super::context::Context;
use super::layout::{self, ARRAYS, Arrays, KEPT, Lane, PARAMETERS, Part, Status, TILE};
use super::phase::{Dispatch, Phase};
use crate::flow::field::{
    BackendError, GrowthState, LinearField, LinearGrid, Parameters, Placed, Schedule,
};

/// Invocations per workgroup of `contract.wgsl` and `vertex_gradients.wgsl`.
const GROUP: u64 = 64;
/// Bytes of a row's flow, or of its loss gradient.
const ROW_BYTES: u64 = 16;

/// The buffers of one fit of the linear model.
#[derive(Debug)]
pub(super) struct LinearFit {
    grid: LinearGrid,
    /// Parameters, an unused array, Adam's moments and the result, as those of a network.
    pub(super) arrays: wgpu::Buffer,
    /// The derivatives of the loss by the parameters.
    pub(super) gradients: wgpu::Buffer,
    pub(super) flows: wgpu::Buffer,
    pub(super) loss_gradients: wgpu::Buffer,
    /// The records of the grid and of its axes, and the encodings of these.
    record: wgpu::Buffer,
    axes: [wgpu::Buffer; 3],
    encodings: [wgpu::Buffer; 3],
    /// The points on the grid in the order of the batches, and each batch by voxel.
    placed: wgpu::Buffer,
    by_voxel: wgpu::Buffer,
    /// Displacements of the vertices, the derivatives of the loss by them, and two of the products.
    values: wgpu::Buffer,
    value_gradients: wgpu::Buffer,
    between: [wgpu::Buffer; 2],
    /// Empty without total variation.
    inverse_lengths: wgpu::Buffer,
    /// Sums of lengths of the total variation; none without it.
    sums: Option<wgpu::Buffer>,
    /// Counts the fits on the GPU.
    _alive: Arc<()>,
}

impl LinearFit {
    /// The fit of a model on `grid` to the points of `schedule`, which are placed on the grid by
    /// `threads`. Its arrays are not written yet.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if other linear models take the GPU's memory, and
    /// [`BackendError::Memory`] if it is too small.
    pub(super) fn new(
        context: &Context,
        threads: &rayon::ThreadPool,
        grid: LinearGrid,
        variation_weight: f32,
        schedule: &Schedule,
    ) -> Result<Self, BackendError> {
        let alive = Arc::clone(&context.linear_fits);
        let allocate = || Self::allocated(context, threads, grid, variation_weight, schedule);
        let fit = match allocate() {
            Err(BackendError::Busy) => {
                // What other fits have for a moment is free after what is submitted so far.
                context.flush(&mut context.encoder())?;
                allocate()
            }
            fit => fit,
        };
        fit.map_err(|error| match error {
            // No other linear model would release enough, and networks have no memory of their own.
            BackendError::Busy if Arc::strong_count(&alive) <= 2 => BackendError::Memory {
                what: "linear model",
                needed: grid.bytes() as u64,
                available: 0,
            },
            error => error,
        })
    }

    fn allocated(
        context: &Context,
        threads: &rayon::ThreadPool,
        grid: LinearGrid,
        variation_weight: f32,
        schedule: &Schedule,
    ) -> Result<Self, BackendError> {
        let floats = 3 * grid.channel() as u64;
        let points = &schedule.points;
        let placed = || points.par_iter().map(|&point| grid.place(point)).collect();
        let placed: Vec<Placed> = threads.install(placed);
        let mut by_voxel = Vec::with_capacity(points.len());
        for done in 0.. {
            let batch = schedule.batch(done, GrowthState::default());
            let last = batch.end == points.len();
            by_voxel.extend(grid.by_voxel(&placed, batch));
            if last {
                break;
            }
        }
        let records: Vec<_> = placed
            .iter()
            .map(|placed| layout::Placed {
                cell: placed.cell,
                weights: bytemuck::cast(placed.weights),
            })
            .collect();
        let storage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
        let array = || context.empty(floats * 4, storage);
        let rows = schedule.largest_batch(GrowthState::default());
        let rows = rows.next_multiple_of(TILE) as u64;
        let share = grid.variation_share(variation_weight);
        let varies = variation_weight > 0.0;
        let encoding = |axis: usize| context.filled(bytemuck::cast_slice(&grid.encoding(axis)));
        let axis = |axis: usize| context.filled(bytemuck::bytes_of(&axis_record(&grid, axis, 0)));
        let written = storage | wgpu::BufferUsages::COPY_DST;
        Ok(Self {
            arrays: context.empty(ARRAYS as u64 * floats * 4, written)?,
            gradients: array()?,
            flows: context.empty(rows * ROW_BYTES, storage)?,
            loss_gradients: context.empty(rows * ROW_BYTES, storage)?,
            record: context.filled(bytemuck::bytes_of(&grid_record(&grid, share)))?,
            axes: [axis(0)?, axis(1)?, axis(2)?],
            encodings: [encoding(0)?, encoding(1)?, encoding(2)?],
            placed: context.filled(bytemuck::cast_slice(&records))?,
            by_voxel: context.filled(bytemuck::cast_slice(&by_voxel))?,
            values: array()?,
            value_gradients: array()?,
            between: [array()?, array()?],
            inverse_lengths: context.empty(if varies { floats * 4 } else { 0 }, storage)?,
            _alive: Arc::clone(&context.linear_fits),
            sums: match varies {
                true => Some(context.empty(floats.div_ceil(TILE as u64) * 4, storage)?),
                false => None,
            },
            grid,
        })
    }

    /// Floats of one of its arrays.
    pub(super) fn floats(&self) -> usize {
        3 * self.grid.channel()
    }

    /// The same in vec4s.
    pub(super) fn quads(&self) -> u32 {
        self.floats() as u32 / 4
    }

    /// Replaces its arrays.
    ///
    /// # Errors
    /// As [`Context::write`].
    pub(super) fn write(&self, context: &Context, arrays: &Arrays<'_>) -> Result<(), BackendError> {
        let bytes = self.floats() as u64 * 4;
        let writes = arrays.0.map(|(array, parameters)| {
            let floats = &parameters.as_slice()[..self.floats()];
            let contents: &[u8] = bytemuck::cast_slice(floats);
            (&self.arrays, array * bytes, contents)
        });
        context.write(&writes)
    }

    /// All its arrays.
    ///
    /// # Errors
    /// [`BackendError`] if the GPU fails or has no free memory.
    pub(super) fn read(&self, context: &Context) -> Result<[Parameters; ARRAYS], BackendError> {
        context.read_arrays(&self.arrays, PARAMETERS, self.floats())
    }

    /// The field of the result.
    ///
    /// # Errors
    /// [`BackendError`] if the GPU fails or has no free memory.
    pub(super) fn field(&self, context: &Context) -> Result<LinearField, BackendError> {
        let begin = KEPT as u32 * self.floats() as u32;
        let first = axis_record(&self.grid, 0, begin);
        let lane = Lane {
            steps: 1,
            ..Lane::default()
        };
        let [lanes, statuses, first] = context.all_filled([
            bytemuck::bytes_of(&lane),
            bytemuck::bytes_of(&Status::default()),
            bytemuck::bytes_of(&first),
        ])?;
        let [_, y, z] = &self.axes;
        let groups = self.products(
            context,
            [&lanes, &statuses],
            [&first, y, z],
            [&self.arrays, &self.values],
        );
        let mut encoder = context.encoder();
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            let [x, y] = self.product_groups();
            for group in &groups {
                pass.set_pipeline(&context.kernels.linear.contract);
                pass.set_bind_group(0, group, &[]);
                pass.set_immediates(0, bytemuck::bytes_of(&Part::default()));
                pass.dispatch_workgroups(x, y, 1);
            }
        }
        let read = context.finish(encoder, &self.values, self.floats() as u64 * 4)?;
        let floats = read.as_chunks::<4>().0.iter();
        Ok(LinearField {
            grid: self.grid,
            values: floats.map(|&bytes| f32::from_ne_bytes(bytes)).collect(),
        })
    }

    /// The products with the encodings of the three axes.
    fn products(
        &self,
        context: &Context,
        [lanes, statuses]: [&wgpu::Buffer; 2],
        axes: [&wgpu::Buffer; 3],
        [from, to]: [&wgpu::Buffer; 2],
    ) -> [wgpu::BindGroup; 3] {
        let [first, second] = &self.between;
        let [x, y, z] = &self.encodings;
        let product = |axis, encoding, from, to| {
            let contract = &context.kernels.linear.contract;
            context.bound(contract, &[lanes, statuses, axis, encoding, from, to])
        };
        [
            product(axes[0], x, from, first),
            product(axes[1], y, first, second),
            product(axes[2], z, second, to),
        ]
    }

    /// Workgroups of a product.
    fn product_groups(&self) -> [u32; 2] {
        spread((self.floats() as u64).div_ceil(GROUP) as u32)
    }
}

/// The record of the grid, with the weight of a length of the total variation.
fn grid_record(grid: &LinearGrid, variation: f32) -> layout::Grid {
    layout::Grid {
        vertices: grid.vertices.map(|count| count as u32),
        row: grid.row() as u32,
        plane: grid.plane() as u32,
        channel: grid.channel() as u32,
        variation,
    }
}

/// The record of an axis, for inputs from the float `begin` on.
fn axis_record(grid: &LinearGrid, axis: usize, begin: u32) -> layout::Axis {
    let count = grid.vertices[axis];
    let (stride, extent) = match axis {
        0 => (1, grid.row()),
        1 => (grid.row(), count),
        _ => (grid.plane(), count),
    };
    layout::Axis {
        stride: stride as u32,
        extent: extent as u32,
        count: count as u32,
        pitch: grid.encoding_row(axis) as u32,
        begin,
    }
}

/// The kernels of the linear model, bound to a submission's buffers.
pub(super) struct LinearPhases<'a> {
    context: &'a Context,
    fit: &'a LinearFit,
    /// From the parameters to the displacements of the vertices.
    decode: [wgpu::BindGroup; 3],
    variation: Option<[wgpu::BindGroup; 2]>,
    blend: wgpu::BindGroup,
    vertex_gradients: wgpu::BindGroup,
    /// From the derivatives by the displacements to those by the parameters.
    encode: [wgpu::BindGroup; 3],
}

impl<'a> LinearPhases<'a> {
    pub(super) fn bind(context: &'a Context, buffers: &Buffers, fit: &'a LinearFit) -> Self {
        let Buffers {
            lanes,
            steps,
            statuses,
            ..
        } = buffers;
        let kernels = &context.kernels.linear;
        let axes = fit.axes.each_ref();
        let records = [lanes, statuses];
        Self {
            context,
            fit,
            decode: fit.products(context, records, axes, [&fit.arrays, &fit.values]),
            variation: fit.sums.as_ref().map(|sums| {
                let (values, lengths) = (&fit.values, &fit.inverse_lengths);
                let measured = [lanes, statuses, &fit.record, values, lengths, sums];
                [
                    context.bound(&kernels.variation, &measured),
                    context.bound(
                        &kernels.reduce_variation,
                        &[lanes, &fit.record, sums, statuses],
                    ),
                ]
            }),
            blend: context.bound(
                &kernels.blend,
                &[
                    lanes,
                    steps,
                    statuses,
                    &fit.record,
                    &fit.placed,
                    &fit.values,
                    &fit.flows,
                ],
            ),
            vertex_gradients: context.bound(
                &kernels.vertex_gradients,
                &[
                    lanes,
                    steps,
                    statuses,
                    &fit.record,
                    &fit.placed,
                    &fit.by_voxel,
                    &fit.loss_gradients,
                    &fit.values,
                    &fit.inverse_lengths,
                    &fit.value_gradients,
                ],
            ),
            encode: fit.products(
                context,
                records,
                axes,
                [&fit.value_gradients, &fit.gradients],
            ),
        }
    }

    /// The dispatches of a phase of the model.
    pub(super) fn dispatches(&self, phase: Phase) -> Vec<Dispatch<'_>> {
        let kernels = &self.context.kernels.linear;
        let groups = self.fit.product_groups();
        let product = |group| (&kernels.contract, group, groups);
        match phase {
            Phase::Forward => {
                let rows = self.fit.flows.size() / ROW_BYTES / TILE as u64;
                let blend = (&kernels.blend, &self.blend, spread(rows as u32));
                let variation = self.variation.iter().flat_map(|[measure, reduce]| {
                    [
                        (&kernels.variation, measure, groups),
                        (&kernels.reduce_variation, reduce, [1, 1]),
                    ]
                });
                let decode = self.decode.iter().map(product);
                decode.chain(variation).chain([blend]).collect()
            }
            Phase::Gradients => {
                let vertices = (self.fit.grid.channel() as u64).div_ceil(GROUP) as u32;
                let of_vertices = (
                    &kernels.vertex_gradients,
                    &self.vertex_gradients,
                    spread(vertices),
                );
                let encode = self.encode.iter().map(product);
                core::iter::once(of_vertices).chain(encode).collect()
            }
            _ => Vec::new(),
        }
    }
}
