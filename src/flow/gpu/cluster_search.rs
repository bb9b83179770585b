//! The normals of an object search's target points, and the search of its clusters on the GPU: one
//! workgroup for each cluster. Pairs that are searched at the same time share submissions.

use core::ops::ControlFlow;
use std::sync::OnceLock;

use super::adapter::AdapterKind;
use super::context::Context;
use super::pipelines::{CLUSTER_SOURCE, NORMALS_SOURCE, pipeline};
use super::sharing::{Shared, Submit, Ticketed};
use crate::flow::field::BackendError;
use crate::flow::objects::{FoundInScene, FoundRecord, PackedScene};

/// Most clusters of a submission, and on a software device. The caller's clock is looked at between
/// submissions.
const AT_ONCE: usize = 2048;
const SOFTWARE_AT_ONCE: usize = 64;
/// Invocations of a workgroup, and bytes of its memory; records.wgsl and measure.wgsl have the same.
pub(super) const GROUP: u32 = 512;
pub(super) const GROUP_BYTES: u32 = 32 << 10;
/// Most workgroups of a dispatch; each takes further clusters in turn. And most bytes of their
/// scratch.
const SEARCH_GROUPS: u64 = 1024;
const SCRATCH_BYTES: u64 = 64 << 20;
/// Storage buffers of a kernel.
const STORAGE_BUFFERS: u32 = 8;
/// Invocations of a workgroup that finds normals; normals.wgsl has the same.
pub(super) const NORMALS_GROUP: usize = 64;
/// Most bytes that are read from a submission; those of one scene are fewer.
const READ_BYTES: u64 = 64 << 20;

/// The clusters of a dispatch; search.wgsl has the same.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub(super) struct Part {
    pub(super) first: u32,
    pub(super) count: u32,
}

/// The kernels of an object search.
struct Kernels {
    normals: wgpu::ComputePipeline,
    search: wgpu::ComputePipeline,
}

/// The searches of clusters on one GPU.
#[derive(Default)]
pub(super) struct ClusterSearches {
    /// The kernels, which are built at the first search.
    kernels: OnceLock<Kernels>,
    waiting: Shared<ScenePart, FoundInScene>,
}

impl ClusterSearches {
    /// Finds the normals of a scene and searches its clusters, and ends early where `is_over` is true.
    /// Scenes that are searched at the same time share submissions.
    ///
    /// # Errors
    /// [`BackendError::Busy`] or [`BackendError::Memory`] if the GPU lacks memory, and
    /// [`BackendError::Lost`] or [`BackendError::Device`] if it fails.
    pub(super) fn search(
        &self,
        context: &Context,
        kind: AdapterKind,
        packed: &PackedScene,
        is_over: &dyn Fn() -> bool,
    ) -> Result<FoundInScene, BackendError> {
        let search = Search {
            context,
            kernels: self.kernels(context)?,
            at_once: match kind {
                AdapterKind::Software => SOFTWARE_AT_ONCE,
                _ => AT_ONCE,
            },
        };
        let clusters = packed.clusters.len();
        let scene = search.uploaded(packed)?;
        let mut found = FoundInScene::default();
        while found.clusters.len() < clusters && !is_over() {
            let first = found.clusters.len();
            let part = scene.part(first, (clusters - first).min(search.at_once));
            let is_over = || is_over().then_some(());
            let waiting = &self.waiting;
            match waiting.run(&context.watchdog, part, &search, &is_over)? {
                ControlFlow::Continue(of_part) => {
                    found.clusters.extend(of_part.clusters);
                    found.normals.extend(of_part.normals);
                }
                ControlFlow::Break(()) => break,
            }
        }
        // The host measures distances along them, also where no cluster was searched.
        let (normals, count) = &scene.normals;
        if found.normals.len() < *count {
            let bytes = buffer_bytes::<[f32; 4]>(*count);
            found.normals = all_of(&context.finish(context.encoder(), normals, bytes)?);
        }
        Ok(found)
    }

    /// # Errors
    /// [`BackendError::Lost`] if the GPU is lost.
    fn kernels(&self, context: &Context) -> Result<&Kernels, BackendError> {
        let built = |source: (&str, &str)| pipeline(&context.device, &[source], source.0, &[]);
        let kernels = self.kernels.get_or_init(|| Kernels {
            normals: built(NORMALS_SOURCE),
            search: built(CLUSTER_SOURCE),
        });
        context.watchdog.check()?;
        Ok(kernels)
    }
}

/// Whether the GPU can run the kernels.
pub(super) fn has_kernel(context: &Context) -> bool {
    let limits = context.device.limits();
    limits.max_compute_invocations_per_workgroup >= GROUP
        && limits.max_compute_workgroup_size_x >= GROUP
        && limits.max_compute_workgroup_storage_size >= GROUP_BYTES
        && limits.max_storage_buffers_per_shader_stage >= STORAGE_BUFFERS
}

/// A scene in the memory of the GPU.
struct UploadedScene {
    group: wgpu::BindGroup,
    results: wgpu::Buffer,
    normals: Normals,
    /// Most workgroups that its scratch suffices for.
    groups: u32,
}

/// The normals of a scene, and their number.
type Normals = (wgpu::Buffer, usize);

impl UploadedScene {
    /// Its clusters from `first` on.
    fn part(&self, first: usize, count: usize) -> ScenePart {
        ScenePart {
            normals: (first == 0).then(|| self.normals.clone()),
            group: self.group.clone(),
            results: self.results.clone(),
            groups: self.groups.min(count as u32),
            part: Part {
                first: first as u32,
                count: count as u32,
            },
        }
    }
}

/// Clusters of a scene that are searched by one dispatch.
struct ScenePart {
    /// To be read with the first part.
    normals: Option<Normals>,
    group: wgpu::BindGroup,
    results: wgpu::Buffer,
    /// Number of workgroups.
    groups: u32,
    part: Part,
}

impl ScenePart {
    /// Bytes of the normals and of the records that are read after its search.
    fn bytes(&self) -> [u64; 2] {
        let normals = self.normals.as_ref().map_or(0, |(_, count)| *count);
        [
            buffer_bytes::<[f32; 4]>(normals),
            buffer_bytes::<FoundRecord>(self.part.count as usize),
        ]
    }
}

/// How parts of scenes are searched.
struct Search<'a> {
    context: &'a Context,
    kernels: &'a Kernels,
    /// Most clusters of a submission.
    at_once: usize,
}

impl Search<'_> {
    /// The scene on the GPU. Its normals are found before what is submitted next.
    fn uploaded(&self, packed: &PackedScene) -> Result<UploadedScene, BackendError> {
        let context = self.context;
        let clusters = packed.clusters.len();
        let scratch = u64::from(packed.scene.scratch_words) * 4;
        let groups = SEARCH_GROUPS.min(SCRATCH_BYTES / scratch.max(1)).max(1);
        let groups = groups.min(clusters as u64);
        let [words, scene, views, points, records] = context.all_filled([
            bytemuck::cast_slice(&packed.words),
            bytemuck::bytes_of(&packed.scene),
            bytemuck::cast_slice(&packed.views),
            bytemuck::cast_slice(&packed.points),
            bytemuck::cast_slice(&packed.clusters),
        ])?;
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
        let scratch = context.empty(groups * scratch, wgpu::BufferUsages::STORAGE)?;
        let results = context.empty(buffer_bytes::<FoundRecord>(clusters), usage)?;
        let targets = packed.views.iter();
        let targets = targets.map(|view| (view.free.count + view.taken.count) as usize);
        let normals_count = targets.clone().sum();
        let normals = context.empty(buffer_bytes::<[f32; 4]>(normals_count), usage)?;
        let of_normals = [&words, &scene, &views, &points, &normals];
        let of_search = [&records, &scratch, &results];
        let of_search: Vec<_> = of_normals.into_iter().chain(of_search).collect();
        let mut encoder = context.encoder();
        {
            let untimed = wgpu::ComputePassDescriptor::default();
            let mut pass = encoder.begin_compute_pass(&untimed);
            let groups = targets.max().unwrap_or(0).div_ceil(NORMALS_GROUP);
            pass.set_pipeline(&self.kernels.normals);
            pass.set_bind_group(0, &context.bound(&self.kernels.normals, &of_normals), &[]);
            pass.dispatch_workgroups(groups as u32, packed.views.len() as u32, 1);
        }
        context.queue.submit([encoder.finish()]);
        Ok(UploadedScene {
            group: context.bound(&self.kernels.search, &of_search),
            results,
            normals: (normals, normals_count),
            groups: groups as u32,
        })
    }
}

impl Submit<ScenePart, FoundInScene> for Search<'_> {
    fn take(&self, waiting: &mut Vec<Ticketed<ScenePart>>) -> Vec<Ticketed<ScenePart>> {
        let (mut clusters, mut bytes) = (0, 0);
        let fitting = waiting.iter().take_while(|(_, of_scene)| {
            clusters += of_scene.part.count as usize;
            bytes += of_scene.bytes().iter().sum::<u64>();
            clusters <= self.at_once && bytes <= READ_BYTES
        });
        let fitting = fitting.count();
        waiting.drain(..fitting).collect()
    }

    fn submit(&self, parts: &[&ScenePart]) -> Result<Vec<FoundInScene>, BackendError> {
        let mut encoder = self.context.encoder();
        {
            let untimed = wgpu::ComputePassDescriptor::default();
            let mut pass = encoder.begin_compute_pass(&untimed);
            pass.set_pipeline(&self.kernels.search);
            // No barrier is needed between scenes, because they share no buffer.
            for of_scene in parts {
                pass.set_bind_group(0, &of_scene.group, &[]);
                pass.set_immediates(0, bytemuck::bytes_of(&of_scene.part));
                pass.dispatch_workgroups(of_scene.groups, 1, 1);
            }
        }
        let found = parts.iter().flat_map(|of_scene| {
            let [normals, records] = of_scene.bytes();
            let first = buffer_bytes::<FoundRecord>(of_scene.part.first as usize);
            let of_normals = of_scene.normals.iter();
            let of_normals = of_normals.map(move |(buffer, _)| (buffer, 0, normals));
            of_normals.chain([(&of_scene.results, first, records)])
        });
        let read = self
            .context
            .finish_all(encoder, &found.collect::<Vec<_>>())?;
        let sizes = parts.iter().map(|of_scene| of_scene.bytes());
        let mut left = &read[..];
        let mut next = |bytes: u64| left.split_off(..bytes as usize).unwrap_or_default();
        Ok(sizes
            .map(|[normals, records]| FoundInScene {
                normals: all_of(next(normals)),
                clusters: all_of(next(records)),
            })
            .collect())
    }
}

/// The records that some bytes are.
fn all_of<T: bytemuck::AnyBitPattern>(bytes: &[u8]) -> Vec<T> {
    let each = bytes.chunks_exact(size_of::<T>());
    each.map(bytemuck::pod_read_unaligned).collect()
}

/// Bytes of so many records.
fn buffer_bytes<T>(records: usize) -> u64 {
    (records * size_of::<T>()) as u64
}

#[cfg(test)]
mod tests;
