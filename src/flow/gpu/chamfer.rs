//! A target cloud on the GPU for the Chamfer distance: nearest neighbors by all distances.

use std::sync::Arc;

use super::allocation::{Allocation, POINT_WORDS};
use super::chamfer_phases::search_groups;
use super::device::Device;
use super::layout::{Cloud, Lane, Part, Status, Step, TILE};
use crate::flow::data::{Control, Point};
use crate::flow::field::{BackendError, check_chamfer, length};
use crate::flow::options::ChamferOptions;

/// The most points of a search apart from a fit.
const SEARCHED: usize = 1 << 18;

/// A target cloud in the GPU's store, with room for what its searches find.
pub(super) struct GpuCloud {
    pub(super) device: Arc<Device>,
    pub(super) record: Cloud,
    target: Vec<Point>,
    pub(super) allocation: Allocation,
}

impl GpuCloud {
    /// Writes `target` to the store, with room for searches and fits of `points` source
    /// points.
    ///
    /// # Errors
    /// [`BackendError`] if the options are refused, the search is by k-d trees, the control
    /// interrupts, or the GPU has too little memory.
    pub(super) fn new(
        device: &Arc<Device>,
        points: usize,
        target: &[Point],
        options: &ChamferOptions,
        control: &dyn Control,
    ) -> Result<Self, BackendError> {
        check_chamfer(options, target)?;
        if let Some(text) = options.lacks_gpu_kernels() {
            return Err(BackendError::Unsupported(text));
        }
        let (source, targets) = (points as u64, target.len() as u64);
        let deformed = targets * POINT_WORDS;
        let nearest = deformed + source * POINT_WORDS;
        let sources = nearest + source;
        let words = sources + targets;
        let allocation = Allocation::take(device, "target cloud", words, points, control)?;
        let at = |words: u64| allocation.offset + words as u32;
        let record = Cloud {
            target_points: at(0),
            targets: targets as u32,
            deformed: at(deformed),
            nearest: at(nearest),
            sources: at(sources),
        };
        let bytes = bytemuck::cast_slice(target);
        let offset = u64::from(allocation.offset) * 4;
        let context = &device.context;
        context.write(&[(&context.buffers.store, offset, bytes)])?;
        Ok(Self {
            device: Arc::clone(device),
            record,
            target: target.to_vec(),
            allocation,
        })
    }

    /// The distance from each of `points` to the nearest target point, metres.
    ///
    /// # Errors
    /// [`BackendError`] if the GPU fails or has no free memory.
    pub(super) fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        let nearest = self.nearest(points)?;
        let off = |(&[x, y, z], index): (&Point, u32)| {
            let [to_x, to_y, to_z] = self.target[index as usize];
            length([to_x - x, to_y - y, to_z - z])
        };
        Ok(points.iter().zip(nearest).map(off).collect())
    }

    /// The index of the target point nearest to each of `points`. The search has buffers of its own,
    /// because those of the store may hold the neighbors of a fit.
    ///
    /// # Errors
    /// As [`Self::distances`].
    pub(super) fn nearest(&self, points: &[Point]) -> Result<Vec<u32>, BackendError> {
        let most = (self.device.context.most_distances / self.target.len()).clamp(TILE, SEARCHED);
        let mut found = Vec::with_capacity(points.len());
        for points in points.chunks(most) {
            found.extend(self.nearest_of_some(points)?);
        }
        Ok(found)
    }

    /// The same in one search.
    fn nearest_of_some(&self, points: &[Point]) -> Result<Vec<u32>, BackendError> {
        let context = &self.device.context;
        let (targets, count) = (self.target.len() as u64, points.len() as u64);
        let deformed = targets * POINT_WORDS;
        let nearest = deformed + count * POINT_WORDS;
        let usage = wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::COPY_DST
            | wgpu::BufferUsages::COPY_SRC;
        let store = context.empty((nearest + count) * 4, usage)?;
        context.write(&[
            (&store, 0, bytemuck::cast_slice(&self.target)),
            (&store, deformed * 4, bytemuck::cast_slice(points)),
        ])?;
        let lane = Lane {
            cloud: Cloud {
                target_points: 0,
                targets: targets as u32,
                deformed: deformed as u32,
                nearest: nearest as u32,
                sources: 0,
            },
            steps: 1,
            ..Lane::default()
        };
        let step = Step {
            count: count as u32,
            searches: 1,
            ..Step::default()
        };
        let [lanes, steps, statuses] = context.all_filled([
            bytemuck::bytes_of(&lane),
            bytemuck::bytes_of(&step),
            bytemuck::bytes_of(&Status::default()),
        ])?;
        let pipeline = &context.kernels.nearest;
        let group = context.bound(pipeline, &[&store, &lanes, &steps, &statuses]);
        let tiles = points.len().div_ceil(TILE);
        let mut encoder = context.encoder();
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, &group, &[]);
            let part = Part {
                tiles: tiles as u32,
                ..Part::default()
            };
            pass.set_immediates(0, bytemuck::bytes_of(&part));
            // Only the search of target points, in the first row.
            pass.dispatch_workgroups(search_groups(tiles), 1, 1);
        }
        let read = context.finish_from(encoder, &store, nearest * 4, count * 4)?;
        let words = read.as_chunks::<4>().0.iter().take(points.len());
        Ok(words.map(|&bytes| u32::from_ne_bytes(bytes)).collect())
    }
}
