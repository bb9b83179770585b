//! Half precision on the GPU's matrix units: the kernels of a tile size, and their bindings in an
//! iteration.

use super::buffers::{Buffers, spread};
use super::context::Context;
use super::matrix_units::Tile;
use super::phase::{Dispatch, Phase};
use super::pipelines::HalfKernels;
use super::tiling::Wave;
use crate::flow::field::{BackendError, MIDDLE_LAYERS, WIDTH};

/// Half-precision values per lane: the weights of its middle layers.
const LANE_HALVES: u64 = (MIDDLE_LAYERS * WIDTH * WIDTH) as u64;

/// The half-precision kernels for matrix units; [`super::self_test`] checks their results.
#[derive(Debug)]
pub(super) struct Units {
    pub(super) tile: Tile,
    kernels: HalfKernels,
    /// The middle layers' weights, see `halve.wgsl`: 0.2 MB per lane in addition to the GPU's
    /// budget. Allocated when half precision is first requested.
    halves: wgpu::Buffer,
}

impl Units {
    /// Builds the kernels from `sources`, for `lanes` lanes.
    ///
    /// # Errors
    /// [`BackendError`] if the driver rejects a kernel, or the GPU has no free memory.
    pub(super) fn new(
        context: &Context,
        tile: Tile,
        sources: &[(&str, &str)],
        lanes: u64,
    ) -> Result<Self, BackendError> {
        let halves = lanes * LANE_HALVES * 2;
        Ok(Self {
            tile,
            kernels: HalfKernels::new(&context.device, sources)?,
            halves: context.empty(halves, wgpu::BufferUsages::STORAGE)?,
        })
    }
}

/// The half-precision kernels, bound to a submission's buffers.
pub(super) struct HalfPhases<'a> {
    kernels: &'a HalfKernels,
    halve: wgpu::BindGroup,
    forward: wgpu::BindGroup,
    backward: wgpu::BindGroup,
    gradients: wgpu::BindGroup,
    outer_gradients: wgpu::BindGroup,
}

impl<'a> HalfPhases<'a> {
    pub(super) fn bind(
        context: &Context,
        buffers: &Buffers,
        units: &'a Units,
        [tiles, chunks]: [&wgpu::Buffer; 2],
    ) -> Self {
        let Buffers {
            store,
            networks,
            activations,
            deltas,
            flows,
            loss_gradients,
            partials,
            lanes,
            steps,
            statuses,
            ..
        } = buffers;
        let (kernels, halves) = (&units.kernels, &units.halves);
        Self {
            kernels,
            halve: context.bound(&kernels.halve, &[lanes, statuses, networks, halves]),
            forward: context.bound(
                &kernels.forward,
                &[
                    store,
                    networks,
                    lanes,
                    steps,
                    tiles,
                    statuses,
                    halves,
                    flows,
                    activations,
                ],
            ),
            backward: context.bound(
                &kernels.backward,
                &[
                    networks,
                    tiles,
                    statuses,
                    loss_gradients,
                    activations,
                    lanes,
                    steps,
                    halves,
                    deltas,
                ],
            ),
            gradients: context.bound(
                &kernels.gradients,
                &[
                    steps,
                    chunks,
                    statuses,
                    activations,
                    deltas,
                    lanes,
                    partials,
                ],
            ),
            outer_gradients: context.bound(
                &kernels.outer_gradients,
                &[
                    store,
                    lanes,
                    steps,
                    chunks,
                    statuses,
                    activations,
                    deltas,
                    loss_gradients,
                    partials,
                ],
            ),
        }
    }

    /// The dispatches of a phase of the model.
    pub(super) fn dispatches(&self, phase: Phase, wave: &Wave, lanes: u32) -> Vec<Dispatch<'_>> {
        let kernels = self.kernels;
        // A workgroup processes half a tile.
        let halves = spread(2 * wave.tiles as u32);
        let chunks = wave.chunks as u32;
        match phase {
            Phase::Halve => {
                let groups = LANE_HALVES as u32 / 4 / HALVE_GROUP;
                vec![(&kernels.halve, &self.halve, [groups, lanes])]
            }
            Phase::Forward => vec![(&kernels.forward, &self.forward, halves)],
            Phase::Backward => vec![(&kernels.backward, &self.backward, halves)],
            Phase::Gradients => vec![
                (
                    &kernels.gradients,
                    &self.gradients,
                    [chunks, MIDDLE_LAYERS as u32],
                ),
                (&kernels.outer_gradients, &self.outer_gradients, [chunks, 2]),
            ],
            _ => Vec::new(),
        }
    }
}

/// Invocations per workgroup of `halve.wgsl`.
const HALVE_GROUP: u32 = 256;
