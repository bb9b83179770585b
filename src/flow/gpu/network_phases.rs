//! The kernels of networks in single precision, bound to a submission.

use super::buffers::{Buffers, spread};
use super::context::Context;
use super::phase::{Dispatch, Phase};
use super::tiling::Wave;
use crate::flow::field::MIDDLE_LAYERS;

/// The kernels of networks in single precision, bound to a submission's buffers.
pub(super) struct NetworkPhases<'a> {
    context: &'a Context,
    forward: wgpu::BindGroup,
    backward: wgpu::BindGroup,
    gradients: wgpu::BindGroup,
    transpose: wgpu::BindGroup,
}

impl<'a> NetworkPhases<'a> {
    pub(super) fn bind(
        context: &'a Context,
        buffers: &Buffers,
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
        let kernels = &context.kernels;
        Self {
            context,
            forward: context.bound(
                &kernels.forward,
                &[
                    store,
                    networks,
                    lanes,
                    steps,
                    tiles,
                    statuses,
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
                    deltas,
                ],
            ),
            gradients: context.bound(
                &kernels.gradients,
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
            transpose: context.bound(&kernels.transpose, &[statuses, lanes, networks]),
        }
    }

    /// The dispatches of a phase of the model.
    pub(super) fn dispatches(&self, phase: Phase, wave: &Wave, lanes: u32) -> Vec<Dispatch<'_>> {
        let kernels = &self.context.kernels;
        let tiles = spread(wave.tiles as u32);
        match phase {
            Phase::Forward => vec![(&kernels.forward, &self.forward, tiles)],
            Phase::Backward => vec![(&kernels.backward, &self.backward, tiles)],
            Phase::Gradients => {
                let groups = [wave.chunks as u32, MIDDLE_LAYERS as u32 + 2];
                vec![(&kernels.gradients, &self.gradients, groups)]
            }
            Phase::Transpose => {
                let squares = MIDDLE_LAYERS as u32 * SQUARES;
                vec![(&kernels.transpose, &self.transpose, [squares, lanes])]
            }
            _ => Vec::new(),
        }
    }
}

/// Squares of 32 x 32 weights per layer, see `transpose.wgsl`.
const SQUARES: u32 = 16;
