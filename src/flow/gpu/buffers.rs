//! The buffers of an opened GPU, and the dispatch dimensions over their rows.

use super::adapter::Adapter;
use super::layout;
use super::layout::STEPS;
use super::memory::{Budget, GpuOptions};
use crate::flow::field::BackendError;

/// Maximum number of workgroups along one dimension of a dispatch.
pub(super) const MOST_GROUPS: u32 = 65_535;

/// The buffers that are allocated when the GPU is opened, with the sizes of a [`Budget`].
pub(super) struct Buffers {
    /// Prepared targets and points.
    pub(super) store: wgpu::Buffer,
    pub(super) networks: wgpu::Buffer,
    pub(super) activations: wgpu::Buffer,
    pub(super) deltas: wgpu::Buffer,
    pub(super) flows: wgpu::Buffer,
    pub(super) loss_gradients: wgpu::Buffer,
    pub(super) partials: wgpu::Buffer,
    pub(super) lanes: wgpu::Buffer,
    pub(super) steps: wgpu::Buffer,
    pub(super) statuses: wgpu::Buffer,
    pub(super) losses: wgpu::Buffer,
}

/// Bytes of a row's flow, or of its loss gradient.
const ROW_VECTOR_BYTES: u64 = 16;

impl Buffers {
    /// Allocates the buffers. If no size was requested and the GPU has less memory, the size is
    /// halved until the buffers fit.
    pub(super) fn take(
        device: &wgpu::Device,
        adapter: &Adapter,
        options: &GpuOptions,
    ) -> Result<(Budget, Self), BackendError> {
        let asked = options.memory_bytes;
        let mut bytes = asked.unwrap_or_else(|| Budget::usual(adapter.kind, options.lanes));
        let binding = largest(device, wgpu::BufferUsages::STORAGE);
        loop {
            let budget = Budget::new(options.lanes, bytes, binding)?;
            match Self::allocate(device, &budget, wgpu::BufferUsages::empty()) {
                Ok(buffers) => return Ok((budget, buffers)),
                Err(BackendError::Memory { .. }) if asked.is_none() => bytes /= 2,
                Err(error) => return Err(error),
            }
        }
    }

    /// Frees the memory as soon as the GPU has done what was submitted. Later use is an error.
    pub(super) fn destroy(&self) {
        let Self {
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
            losses,
        } = self;
        for buffer in [
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
            losses,
        ] {
            buffer.destroy();
        }
    }

    /// Number of rows of a layer's activations.
    pub(super) fn rows(&self) -> u64 {
        self.flows.size() / ROW_VECTOR_BYTES
    }

    /// Allocates the buffers of `budget`, each with the additional usages `more`.
    ///
    /// # Errors
    /// [`BackendError::Memory`] if the GPU has too little memory.
    pub(super) fn allocate(
        device: &wgpu::Device,
        budget: &Budget,
        more: wgpu::BufferUsages,
    ) -> Result<Self, BackendError> {
        let storage = wgpu::BufferUsages::STORAGE | more;
        let (to, from) = (wgpu::BufferUsages::COPY_DST, wgpu::BufferUsages::COPY_SRC);
        let buffer = |what, bytes, usage| allocated(device, what, bytes, usage, Mapping::None);
        let records = |bytes: usize| budget.lanes * bytes as u64;
        let row_vectors = budget.rows * ROW_VECTOR_BYTES;
        Ok(Self {
            store: buffer("store", budget.store_words * 4, storage | to | from)?,
            networks: buffer("networks", budget.network_bytes(), storage | to | from)?,
            activations: buffer("activations", budget.row_bytes(), storage)?,
            deltas: buffer("deltas", budget.row_bytes(), storage)?,
            flows: buffer("flows", row_vectors, storage)?,
            loss_gradients: buffer("loss gradients", row_vectors, storage)?,
            partials: buffer("gradients", budget.chunk_bytes(), storage)?,
            lanes: buffer("lanes", records(size_of::<layout::Lane>()), storage | to)?,
            steps: buffer(
                "steps",
                records(STEPS * size_of::<layout::Step>()),
                storage | to,
            )?,
            statuses: buffer(
                "statuses",
                records(size_of::<layout::Status>()),
                storage | to | from,
            )?,
            losses: buffer("losses", records(STEPS * size_of::<f32>()), storage | from)?,
        })
    }
}

/// Bytes of the largest buffer with `usage`. A kernel binds its buffers as a whole.
pub(super) fn largest(device: &wgpu::Device, usage: wgpu::BufferUsages) -> u64 {
    let limits = device.limits();
    match usage.contains(wgpu::BufferUsages::STORAGE) {
        true => limits
            .max_buffer_size
            .min(limits.max_storage_buffer_binding_size),
        false => limits.max_buffer_size,
    }
}

/// A buffer, an offset in it, and the bytes to write there: a whole number of 32-bit words.
pub(super) type Write<'a> = (&'a wgpu::Buffer, u64, &'a [u8]);

/// Whether the host writes to a buffer before its first use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Mapping {
    None,
    AtCreation,
}

/// Allocates a buffer.
///
/// # Errors
/// [`BackendError::Memory`] if the size exceeds the device's limit, or the GPU has too little
/// memory.
pub(super) fn allocated(
    device: &wgpu::Device,
    what: &'static str,
    bytes: u64,
    usage: wgpu::BufferUsages,
    mapping: Mapping,
) -> Result<wgpu::Buffer, BackendError> {
    let limit = largest(device, usage);
    let refused = |available: u64| BackendError::Memory {
        what,
        needed: bytes,
        available,
    };
    if bytes > limit {
        return Err(refused(limit));
    }
    let scope = device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(what),
        size: bytes,
        usage,
        mapped_at_creation: mapping == Mapping::AtCreation,
    });
    match pollster::block_on(scope.pop()) {
        None => Ok(buffer),
        Some(_) => Err(refused(0)),
    }
}

/// Distributes `groups` workgroups over two dimensions of a dispatch.
pub(super) fn spread(groups: u32) -> [u32; 2] {
    let across = groups.clamp(1, MOST_GROUPS);
    [across, groups.div_ceil(across)]
}
