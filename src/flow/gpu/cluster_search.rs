//! The search of an object search's clusters on the GPU: one workgroup for each cluster. Pairs that
//! are searched at the same time share submissions.

use core::ops::ControlFlow;
use std::sync::OnceLock;

use super::adapter::AdapterKind;
use super::context::Context;
use super::pipelines::CLUSTER_SOURCE;
use super::sharing::{Shared, Submit, Ticketed};
use crate::flow::field::BackendError;
use crate::flow::objects::{FoundRecord, PackedScene};

/// Most clusters of a submission, and on a software device. The caller's clock is looked at between
/// submissions.
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

/// The searches of clusters on one GPU.
#[derive(Default)]
pub(super) struct ClusterSearches {
    /// The kernel, which is built at the first search.
    pipeline: OnceLock<wgpu::ComputePipeline>,
    waiting: Shared<ScenePart, Vec<FoundRecord>>,
}

impl ClusterSearches {
    /// Searches the clusters of a scene, and ends early where `is_over` is true. Returns what was
    /// found of the first ones. Scenes that are searched at the same time share submissions.
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
    ) -> Result<Vec<FoundRecord>, BackendError> {
        let search = Search {
            context,
            pipeline: self.kernel(context)?,
            at_once: match kind {
                AdapterKind::Software => SOFTWARE_AT_ONCE,
                _ => AT_ONCE,
            },
        };
        let clusters = packed.clusters.len();
        let scene = search.uploaded(packed)?;
        let mut found = Vec::with_capacity(clusters);
        while found.len() < clusters && !is_over() {
            let part = scene.part(found.len(), (clusters - found.len()).min(search.at_once));
            let is_over = || is_over().then_some(());
            let waiting = &self.waiting;
            match waiting.run(&context.watchdog, part, &search, &is_over)? {
                ControlFlow::Continue(of_part) => found.extend(of_part),
                ControlFlow::Break(()) => break,
            }
        }
        Ok(found)
    }

    /// # Errors
    /// [`BackendError::Lost`] if the GPU is lost.
    fn kernel(&self, context: &Context) -> Result<&wgpu::ComputePipeline, BackendError> {
        let kernel = self.pipeline.get_or_init(|| {
            super::pipelines::pipeline(&context.device, &[CLUSTER_SOURCE], CLUSTER_SOURCE.0, &[])
        });
        context.watchdog.check()?;
        Ok(kernel)
    }
}

/// Whether the GPU can run the kernel.
pub(super) fn has_kernel(context: &Context) -> bool {
    let limits = context.device.limits();
    limits.max_compute_invocations_per_workgroup >= GROUP
        && limits.max_compute_workgroup_size_x >= GROUP
        && limits.max_compute_workgroup_storage_size >= GROUP_BYTES
}

/// A scene in the memory of the GPU.
struct UploadedScene {
    group: wgpu::BindGroup,
    results: wgpu::Buffer,
    /// Most workgroups that its scratch suffices for.
    groups: u32,
}

impl UploadedScene {
    /// Its clusters from `first` on.
    fn part(&self, first: usize, count: usize) -> ScenePart {
        ScenePart {
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
    group: wgpu::BindGroup,
    results: wgpu::Buffer,
    /// Number of workgroups.
    groups: u32,
    part: Part,
}

/// How parts of scenes are searched.
struct Search<'a> {
    context: &'a Context,
    pipeline: &'a wgpu::ComputePipeline,
    /// Most clusters of a submission.
    at_once: usize,
}

impl Search<'_> {
    fn uploaded(&self, packed: &PackedScene) -> Result<UploadedScene, BackendError> {
        let context = self.context;
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
        Ok(UploadedScene {
            group: context.bound(self.pipeline, &buffers),
            results,
            groups: groups as u32,
        })
    }
}

impl Submit<ScenePart, Vec<FoundRecord>> for Search<'_> {
    fn take(&self, waiting: &mut Vec<Ticketed<ScenePart>>) -> Vec<Ticketed<ScenePart>> {
        let mut clusters = 0;
        let fitting = waiting.iter().take_while(|(_, of_scene)| {
            clusters += of_scene.part.count as usize;
            clusters <= self.at_once
        });
        let fitting = fitting.count();
        waiting.drain(..fitting).collect()
    }

    fn submit(&self, parts: &[&ScenePart]) -> Result<Vec<Vec<FoundRecord>>, BackendError> {
        let mut encoder = self.context.encoder();
        {
            let untimed = wgpu::ComputePassDescriptor::default();
            let mut pass = encoder.begin_compute_pass(&untimed);
            pass.set_pipeline(self.pipeline);
            // No barrier is needed between scenes, because they share no buffer.
            for of_scene in parts {
                pass.set_bind_group(0, &of_scene.group, &[]);
                pass.set_immediates(0, bytemuck::bytes_of(&of_scene.part));
                pass.dispatch_workgroups(of_scene.groups, 1, 1);
            }
        }
        let counts = parts.iter().map(|of_scene| of_scene.part.count as usize);
        let bytes = buffer_bytes::<FoundRecord>(counts.clone().sum());
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let all = self.context.empty(bytes, usage)?;
        let mut end = 0;
        for ScenePart { results, part, .. } in parts {
            let first = buffer_bytes::<FoundRecord>(part.first as usize);
            let count = buffer_bytes::<FoundRecord>(part.count as usize);
            encoder.copy_buffer_to_buffer(results, first, &all, end, count);
            end += count;
        }
        let read = self.context.finish(encoder, &all, bytes)?;
        let mut records = read
            .chunks_exact(size_of::<FoundRecord>())
            .map(bytemuck::pod_read_unaligned::<FoundRecord>);
        Ok(counts
            .map(|count| records.by_ref().take(count).collect())
            .collect())
    }
}

/// Bytes of so many records.
fn buffer_bytes<T>(records: usize) -> u64 {
    (records * size_of::<T>()) as u64
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::flow::data::{RigidTransform, Uncontrolled, locked};
    use crate::flow::gpu::tests::shared;
    use crate::flow::host::Host;
    use crate::flow::objects::SearchClouds;
    use crate::flow::options::ObjectOptions;
    use crate::flow::simulate::{Street, StreetOptions};

    /// The scene of a small street.
    fn street(seed: u64) -> PackedScene {
        let options = StreetOptions {
            seed,
            beams: 16,
            azimuth_steps: 400,
            ..StreetOptions::default()
        };
        let pair = Street::new(&options).and_then(|street| street.pair(0));
        let pair = pair.expect("a street");
        let clouds = SearchClouds {
            source: &pair.source,
            target: &pair.target,
            neighbors: &[],
            sweeps: [&pair.source, &pair.target],
            times: None,
            target_from_source: RigidTransform::identity(),
        };
        let taken = Mutex::new(None);
        let take = |scene: &PackedScene, _: &dyn Fn() -> bool| {
            *locked(&taken) = Some(scene.clone());
            Err(BackendError::Busy)
        };
        let host = Host::new(Some(2), None).expect("threads");
        let options = ObjectOptions::default();
        let stopped = host.find_objects_with(&clouds, &options, Some(&take), &Uncontrolled);
        assert!(matches!(stopped, Err(BackendError::Busy)));
        locked(&taken).take().expect("a scene")
    }

    #[test]
    fn parts_of_scenes_in_one_submission_have_the_bits_of_each_alone() {
        let Some(gpu) = shared() else {
            return;
        };
        let device = gpu.device();
        let scenes = [street(3), street(4)];
        let alone = scenes.each_ref().map(|scene| {
            let searches = &device.cluster_searches;
            let found = searches.search(&device.context, device.kind, scene, &|| false);
            found.expect("no error")
        });
        let [first, second] = alone.each_ref().map(Vec::len);
        assert!(first > 4 && second > 4, "{first} and {second} clusters");
        assert!(alone.iter().flatten().any(|found| found.is_found == 1));
        let search = Search {
            context: &device.context,
            pipeline: device
                .cluster_searches
                .kernel(&device.context)
                .expect("a kernel"),
            at_once: first + second,
        };
        let uploaded = scenes
            .each_ref()
            .map(|scene| search.uploaded(scene).expect("memory"));
        let parts = [
            uploaded[1].part(3, second - 3),
            uploaded[0].part(0, first),
            uploaded[1].part(0, 2),
        ];
        let mut waiting: Vec<Ticketed<ScenePart>> = (0..).zip(parts).collect();
        let taken = search.take(&mut waiting);
        assert!(waiting.is_empty());
        let parts: Vec<&ScenePart> = taken.iter().map(|(_, part)| part).collect();
        let found = search.submit(&parts).expect("no error");
        assert_eq!(found, [&alone[1][3..], &alone[0], &alone[1][..2]]);
    }
}
