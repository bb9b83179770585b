//! A target cloud on the GPU for the Chamfer distance: nearest neighbors by all distances.

use std::sync::Arc;

use super::allocation::{Allocation, POINT_WORDS};
use super::chamfer_phases::search_groups;
use super::device::Device;
use super::layout::{Cloud, Lane, Part, Status, Step};
use crate::flow::data::{Control, Point};
use crate::flow::field::{BackendError, check_chamfer, length};
use crate::flow::options::{ChamferOptions, NearestSearch};

/// A target cloud in the GPU's store, with room for what its searches find.
pub(super) struct GpuCloud {
    pub(super) device: Arc<Device>,
    pub(super) record: Cloud,
    target: Vec<Point>,
    /// Words of the cloud and of its searches, without those of the source points that follow.
    words: u64,
    allocation: Allocation,
}

impl GpuCloud {
    /// Writes `target` to the store, with room for searches and fits of `source` points.
    ///
    /// # Errors
    /// [`BackendError`] if the options are refused, the search is by k-d trees, the control
    /// interrupts, or the GPU has too little memory.
    pub(super) fn new(
        device: &Arc<Device>,
        source: usize,
        target: &[Point],
        options: &ChamferOptions,
        control: &dyn Control,
    ) -> Result<Self, BackendError> {
        check_chamfer(options, target)?;
        if options.search == NearestSearch::KdTree {
            let text = "k-d trees are searched on the CPU alone";
            return Err(BackendError::Unsupported(text));
        }
        let (source, targets) = (source as u64, target.len() as u64);
        let deformed = targets * POINT_WORDS;
        let nearest = deformed + source * POINT_WORDS;
        let sources = nearest + source;
        let words = sources + targets;
        let all = words + source * POINT_WORDS;
        let allocation = Allocation::take(device, "target cloud", all, control)?;
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
        let (queue, store) = (&device.context.queue, &device.context.buffers.store);
        queue.write_buffer(store, offset, bytes);
        Ok(Self {
            device: Arc::clone(device),
            record,
            target: target.to_vec(),
            words,
            allocation,
        })
    }

    /// Bytes of the cloud and of what its searches find.
    pub(super) fn bytes(&self) -> usize {
        self.words as usize * 4
    }

    /// Offset in the store of `points` points that are fitted, in words.
    pub(super) fn room_for(&self, points: usize) -> Result<u32, BackendError> {
        self.allocation.room_for(points, self.words)
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

    /// The index of the target point nearest to each of `points`, in buffers of its own.
    pub(super) fn nearest(&self, points: &[Point]) -> Result<Vec<u32>, BackendError> {
        if points.is_empty() {
            return Ok(Vec::new());
        }
        let context = &self.device.context;
        let (targets, count) = (self.target.len() as u64, points.len() as u64);
        let deformed = targets * POINT_WORDS;
        let nearest = deformed + count * POINT_WORDS;
        let usage = wgpu::BufferUsages::STORAGE
            | wgpu::BufferUsages::COPY_DST
            | wgpu::BufferUsages::COPY_SRC;
        let store = context.empty((nearest + count) * 4, usage)?;
        let queue = &context.queue;
        queue.write_buffer(&store, 0, bytemuck::cast_slice(&self.target));
        queue.write_buffer(&store, deformed * 4, bytemuck::cast_slice(points));
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
        let lanes = context.filled(bytemuck::bytes_of(&lane))?;
        let steps = context.filled(bytemuck::bytes_of(&step))?;
        let statuses = context.filled(bytemuck::bytes_of(&Status::default()))?;
        let pipeline = &context.kernels.nearest;
        let group = context.bound(pipeline, &[&store, &lanes, &steps, &statuses]);
        let mut encoder = context.encoder();
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, &group, &[]);
            pass.set_immediates(0, bytemuck::bytes_of(&Part::default()));
            // Only the search of target points, in the first row.
            pass.dispatch_workgroups(search_groups(points.len()), 1, 1);
        }
        let found = context.empty(count * 4, usage)?;
        encoder.copy_buffer_to_buffer(&store, nearest * 4, &found, 0, count * 4);
        let read = context.finish(encoder, &found, count * 4)?;
        let words = read.as_chunks::<4>().0.iter().take(points.len());
        Ok(words.map(|&bytes| u32::from_ne_bytes(bytes)).collect())
    }
}
