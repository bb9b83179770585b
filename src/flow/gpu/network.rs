//! The coordinate network on the GPU: the arrays of a fit, and the kernels of single precision.

use std::sync::Arc;

use super::buffers::{Buffers, spread};
use super::context::Context;
use super::device::Device;
use super::layout::{ARRAYS, Arrays, PARAMETERS, TRANSPOSED};
use super::memory::NETWORK_BYTES;
use super::phase::{Dispatch, Phase};
use super::tiling::Wave;
use crate::flow::field::{
    BackendError, Conditioning, LAID_OUT, MIDDLE_LAYERS, Parameters, mlp, transpose_middle_layers,
};
use crate::flow::options::Precision;

/// A network slot of the GPU. Released on drop.
struct Slot {
    device: Arc<Device>,
    number: u32,
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.device.batch.left();
        self.device.context.give_network_back(self.number);
    }
}

/// The network of one fit.
pub(super) struct NetworkFit {
    slot: Slot,
    pub(super) conditioning: Conditioning,
    pub(super) precision: Precision,
}

impl NetworkFit {
    /// A network with arrays that are not written yet.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if all slots are in use.
    pub(super) fn take(
        device: &Arc<Device>,
        conditioning: Conditioning,
        precision: Precision,
    ) -> Result<Self, BackendError> {
        let number = device.context.take_network()?;
        device.batch.joined();
        Ok(Self {
            slot: Slot {
                device: Arc::clone(device),
                number,
            },
            conditioning,
            precision,
        })
    }

    /// The number of its slot.
    pub(super) fn number(&self) -> u32 {
        self.slot.number
    }

    /// Byte offset of one of its arrays.
    fn at(&self, array: u64) -> u64 {
        (u64::from(self.slot.number) * ARRAYS as u64 + array) * NETWORK_BYTES
    }

    /// Replaces its arrays.
    pub(super) fn write(&self, arrays: &Arrays<'_>) {
        let mut transposed = mlp::zeros();
        transpose_middle_layers(arrays.parameters().as_slice(), transposed.as_mut_slice());
        let context = &self.slot.device.context;
        for (array, parameters) in arrays.0.into_iter().chain([(TRANSPOSED, &transposed)]) {
            let bytes = bytemuck::cast_slice(&parameters.as_slice()[..LAID_OUT]);
            let networks = &context.buffers.networks;
            context.queue.write_buffer(networks, self.at(array), bytes);
        }
    }

    /// All its arrays.
    ///
    /// # Errors
    /// [`BackendError`] if the GPU fails or has no free memory.
    pub(super) fn read(&self) -> Result<[Parameters; ARRAYS], BackendError> {
        let context = &self.slot.device.context;
        let networks = &context.buffers.networks;
        context.read_arrays(networks, self.at(PARAMETERS), LAID_OUT)
    }
}

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
