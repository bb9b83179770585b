//! The phases (kernels) of an iteration, and GPU timestamps.

use super::context::Context;
use crate::flow::field::BackendError;

/// A kernel of an iteration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// Networks in half precision only: rounds the weights for the other kernels, before the first
    /// wave.
    Halve,
    Forward,
    /// Chamfer distance only: the displaced points.
    Deform,
    /// Chamfer distance only: the nearest neighbors of both clouds.
    Nearest,
    Loss,
    Backward,
    Gradients,
    ReduceLoss,
    Step,
    /// Networks in single precision only.
    Transpose,
}

/// A dispatch: pipeline, bind group and workgroups in two dimensions.
pub(super) type Dispatch<'a> = (&'a wgpu::ComputePipeline, &'a wgpu::BindGroup, [u32; 2]);

impl Phase {
    /// The phases that run for each wave, in order.
    pub(super) const OF_A_WAVE: [Self; 4] =
        [Self::Forward, Self::Loss, Self::Backward, Self::Gradients];
    /// The phases that run after all waves, in order.
    pub(super) const OF_THE_END: [Self; 3] = [Self::ReduceLoss, Self::Step, Self::Transpose];
}

/// A set of GPU timestamps.
pub(super) struct Clock {
    set: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    moments: u32,
    tick: f64,
}

impl Clock {
    /// A set of `moments` timestamps; none if the GPU has no timestamps.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if the GPU has no free memory now.
    pub(super) fn new(context: &Context, moments: u32) -> Result<Option<Self>, BackendError> {
        let Some(tick) = context.tick else {
            return Ok(None);
        };
        let scope = context
            .device
            .push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let set = context.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: None,
            ty: wgpu::QueryType::Timestamp,
            count: moments,
        });
        if pollster::block_on(scope.pop()).is_some() {
            return Err(BackendError::Busy);
        }
        let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
        let resolved = context.empty(u64::from(moments) * 8, usage)?;
        Ok(Some(Self {
            set,
            resolved,
            moments,
            tick,
        }))
    }

    /// A compute pass whose begin and end are recorded at these indices.
    pub(super) fn pass<'a>(
        &self,
        encoder: &'a mut wgpu::CommandEncoder,
        begin: Option<u32>,
        end: Option<u32>,
    ) -> wgpu::ComputePass<'a> {
        encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
            label: None,
            timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                query_set: &self.set,
                beginning_of_pass_write_index: begin,
                end_of_pass_write_index: end,
            }),
        })
    }

    /// Writes the timestamps, eight bytes each, to `to` from offset `at`.
    pub(super) fn resolve(&self, encoder: &mut wgpu::CommandEncoder, to: &wgpu::Buffer, at: u64) {
        encoder.resolve_query_set(&self.set, 0..self.moments, &self.resolved, 0);
        let bytes = u64::from(self.moments) * 8;
        encoder.copy_buffer_to_buffer(&self.resolved, 0, to, at, bytes);
    }

    /// Seconds between two of the timestamps that [`Self::resolve`] wrote; none if the second is not
    /// later, as with a driver that does not write them.
    pub(super) fn seconds(&self, moments: &[u8], from: usize, to: usize) -> Option<f64> {
        let at = |index: usize| u64::from_ne_bytes(moments.as_chunks::<8>().0[index]);
        let ticks = at(to).checked_sub(at(from)).filter(|&ticks| ticks > 0)?;
        Some(ticks as f64 * self.tick)
    }
}
