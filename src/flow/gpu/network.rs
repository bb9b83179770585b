//! The coordinate network of one fit on the GPU.

use std::sync::Arc;

use super::buffers::Write;
use super::device::Device;
use super::layout::{ARRAYS, Arrays, PARAMETERS, TRANSPOSED};
use super::memory::NETWORK_BYTES;
use crate::flow::field::{
    BackendError, Conditioning, LAID_OUT, Parameters, mlp, transpose_middle_layers,
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
    ///
    /// # Errors
    /// As [`super::context::Context::write`].
    pub(super) fn write(&self, arrays: &Arrays<'_>) -> Result<(), BackendError> {
        let mut transposed = mlp::zeros();
        transpose_middle_layers(arrays.parameters().as_slice(), transposed.as_mut_slice());
        let context = &self.slot.device.context;
        let all = arrays.0.into_iter().chain([(TRANSPOSED, &transposed)]);
        let writes: Vec<Write<'_>> = all
            .map(|(array, parameters)| {
                let bytes = bytemuck::cast_slice(&parameters.as_slice()[..LAID_OUT]);
                (&context.buffers.networks, self.at(array), bytes)
            })
            .collect();
        context.write(&writes)
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
