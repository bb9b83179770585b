//! The search of an object search's clusters on the GPU: one workgroup for each cluster.

use super::adapter::AdapterKind;
use super::context::Context;
use super::device::Device;
use super::pipelines::CLUSTER_SOURCE;
use crate::flow::field::BackendError;
use crate::flow::objects::{FoundRecord, PackedScene};

/// Clusters that are searched between two looks at the caller's clock, and on a software device.
const AT_ONCE: usize = 2048;
const SOFTWARE_AT_ONCE: usize = 64;
/// Invocations of a workgroup, and bytes of its memory; records.wgsl and measure.wgsl have the same.
pub(super) const GROUP: u32 = 512;
pub(super) const GROUP_BYTES: u32 = 32 << 10;
/// Most workgroups of a dispatch; each takes further clusters in turn. And most bytes of their
/// scratch.
const MOST_GROUPS: u64 = 1024;
const SCRATCH_BYTES: u64 = 64 << 20;

/// The clusters of a dispatch; records.wgsl has the same.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Part {
    pub(super) first: u32,
    pub(super) count: u32,
}

impl Device {
    /// Searches the clusters of a scene, and ends early where `is_over` is true. Returns what was
    /// found of the first ones.
    ///
    /// # Errors
    /// [`BackendError::Busy`] or [`BackendError::Memory`] if the GPU lacks memory, and
    /// [`BackendError::Lost`] or [`BackendError::Device`] if it fails.
    pub(super) fn search_clusters(
        &self,
        packed: &PackedScene,
        is_over: &dyn Fn() -> bool,
    ) -> Result<Vec<FoundRecord>, BackendError> {
        let context = &self.context;
        context.watchdog.check()?;
        let pipeline = self.cluster_pipeline()?;
        let clusters = packed.clusters.len();
        let scratch = u64::from(packed.scene.scratch_words) * 4;
        let groups = MOST_GROUPS.min(SCRATCH_BYTES / scratch.max(1)).max(1);
        let groups = groups.min(clusters as u64);
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
        let results = context.empty(buffer_bytes::<FoundRecord>(clusters), usage)?;
        let bound = [
            context.filled(bytemuck::cast_slice(&packed.words))?,
            context.filled(bytemuck::bytes_of(&packed.scene))?,
            context.filled(bytemuck::cast_slice(&packed.views))?,
            context.filled(bytemuck::cast_slice(&packed.clusters))?,
            context.empty(groups * scratch, wgpu::BufferUsages::STORAGE)?,
        ];
        let points = context.filled(bytemuck::cast_slice(&packed.points))?;
        let buffers: Vec<_> = bound.iter().chain([&results, &points]).collect();
        let group = context.bound(pipeline, &buffers);
        let at_once = match self.kind {
            AdapterKind::Software => SOFTWARE_AT_ONCE,
            _ => AT_ONCE,
        };
        let mut found = Vec::with_capacity(clusters);
        while found.len() < clusters && !is_over() {
            let part = Part {
                first: found.len() as u32,
                count: (clusters - found.len()).min(at_once) as u32,
            };
            let mut encoder = context.encoder();
            {
                let untimed = wgpu::ComputePassDescriptor::default();
                let mut pass = encoder.begin_compute_pass(&untimed);
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, &group, &[]);
                pass.set_immediates(0, bytemuck::bytes_of(&part));
                pass.dispatch_workgroups(part.count.min(groups as u32), 1, 1);
            }
            let at = buffer_bytes::<FoundRecord>(found.len());
            let bytes = buffer_bytes::<FoundRecord>(part.count as usize);
            let read = context.finish_from(encoder, &results, at, bytes)?;
            found.extend(
                read.chunks_exact(size_of::<FoundRecord>())
                    .map(bytemuck::pod_read_unaligned::<FoundRecord>),
            );
        }
        Ok(found)
    }

    /// Whether the GPU can run the kernel that searches clusters.
    pub(super) fn has_cluster_kernel(&self) -> bool {
        let limits = self.context.device.limits();
        limits.max_compute_invocations_per_workgroup >= GROUP
            && limits.max_compute_workgroup_size_x >= GROUP
            && limits.max_compute_workgroup_storage_size >= GROUP_BYTES
    }

    /// The kernel, which is built at the first search.
    fn cluster_pipeline(&self) -> Result<&wgpu::ComputePipeline, BackendError> {
        let pipeline = self.clusters.get_or_init(|| built(&self.context));
        self.context.watchdog.check()?;
        Ok(pipeline)
    }
}

/// Bytes of so many records.
fn buffer_bytes<T>(records: usize) -> u64 {
    (records * size_of::<T>()) as u64
}

fn built(context: &Context) -> wgpu::ComputePipeline {
    super::pipelines::pipeline(&context.device, &[CLUSTER_SOURCE], CLUSTER_SOURCE.0, &[])
}
