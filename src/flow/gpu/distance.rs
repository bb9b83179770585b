//! A target's distance transform on the GPU. The host plans it and builds its coarse field; the GPU
//! fills its bricks.

use std::sync::Arc;

use super::allocation::Allocation;
use super::buffers::spread;
use super::context::Context;
use super::device::Device;
use super::layout;
use crate::flow::data::{Control, Point};
use crate::flow::distance::{
    ABSENT, CoarseField, DistanceError, DistanceOptions, Index, Lattice, Layout, Metric, Sample,
    Sites, VertexSites, codes_per_cell,
};
use crate::flow::field::BackendError;

/// 32-bit words of a brick's 512 16-bit codes.
const BRICK_WORDS: u64 = 256;
/// Maximum number of points per sampling dispatch.
const SAMPLED: usize = 1 << 20;
/// Points per workgroup of `sample.wgsl`.
const SAMPLE_GROUP: usize = 64;

/// A distance transform in the GPU's store.
pub(super) struct GpuTransform {
    pub(super) device: Arc<Device>,
    pub(super) record: layout::Transform,
    pub(super) allocation: Allocation,
}

/// Builds the distance transform of `target` over a grid that covers both clouds, metres.
pub(super) fn build(
    device: &Arc<Device>,
    source: &[Point],
    target: &[Point],
    options: &DistanceOptions,
    control: &dyn Control,
) -> Result<GpuTransform, BackendError> {
    device.context.watchdog.check()?;
    if options.metric == Metric::Chamfer {
        let text = "the published chamfer metric is computed on the CPU alone";
        return Err(BackendError::Unsupported(text));
    }
    if options.sites == Sites::Points {
        let text = "distances to the points themselves are computed on the CPU alone";
        return Err(BackendError::Unsupported(text));
    }
    // Runs on the host's threads, which are released before the GPU's memory is waited for.
    let planned = device.host.threads().install(|| {
        let layout = Layout::plan(source, target, options, control)?;
        let band_m = f64::from(layout.band) * layout.grid.cell;
        let far = CoarseField::build(&layout.grid, &layout.cells, band_m, control)?;
        let sites = VertexSites::new(&layout.cells, layout.band);
        Ok::<_, DistanceError>((layout, far, sites))
    });
    let (layout, far, sites) = planned?;
    let Layout {
        grid, index, band, ..
    } = layout;

    let parts = [
        index.tables.len() as u64,
        index.bricks.len() as u64,
        index.active as u64 * BRICK_WORDS,
        far.distances.len() as u64,
    ];
    let words = parts.iter().sum();
    let what = "distance transform";
    let allocation = Allocation::take(device, what, words, source.len(), control)?;
    let mut offset = u64::from(allocation.offset);
    let offsets = parts.map(|words| {
        let own = offset;
        offset += words;
        own
    });
    let context = &device.context;
    let store = &context.buffers.store;
    context.write(&[
        (store, offsets[0] * 4, bytemuck::cast_slice(&index.tables)),
        (store, offsets[1] * 4, bytemuck::cast_slice(&index.bricks)),
        (store, offsets[3] * 4, bytemuck::cast_slice(&far.distances)),
    ])?;
    fill_bricks(context, &index, &sites, band, offsets[2] as u32)?;

    let lattice = Lattice::new(&grid);
    let record = layout::Transform {
        origin_high: lattice.origin_high,
        origin_low: lattice.origin_low,
        inverse_cell: lattice.inverse_cell,
        code_scale: (grid.cell / codes_per_cell(band)) as f32,
        vertices: lattice.vertices,
        blocks: index.blocks.map(|n| n as u32),
        tables: offsets[0] as u32,
        bricks: offsets[1] as u32,
        codes: offsets[2] as u32,
        far: offsets[3] as u32,
        far_pitch: far.pitch,
        far_vertices: far.vertices.map(|n| n as u32),
    };
    Ok(GpuTransform {
        device: Arc::clone(device),
        record,
        allocation,
    })
}

/// Fills the active bricks on the GPU.
fn fill_bricks(
    context: &Context,
    index: &Index,
    sites: &VertexSites,
    band: i32,
    codes: u32,
) -> Result<(), BackendError> {
    if index.active == 0 {
        return Ok(());
    }
    let positions: Vec<[u32; 3]> = index.active_brick_positions();
    let plan = layout::BrickPlan {
        band,
        rows: sites.columns.starts().len() as u32 - 1,
        bricks: index.active as u32,
        codes,
    };
    let ys = sites.columns.all_y().iter().copied().chain([0]);
    let columns: Vec<_> = ys
        .zip(&sites.layers)
        .map(|(y, &(layer, squares))| layout::Column { y, layer, squares })
        .collect();
    let code_of: Vec<u32> = sites.codes.iter().map(|&code| code.into()).collect();
    let buffers = context.all_filled([
        bytemuck::bytes_of(&plan),
        bytemuck::cast_slice(&positions),
        bytemuck::cast_slice(sites.columns.starts()),
        bytemuck::cast_slice(&columns),
        bytemuck::cast_slice(&sites.squares),
        bytemuck::cast_slice(&code_of),
    ])?;
    let pipeline = &context.kernels.bricks;
    let mut bound: Vec<_> = buffers.iter().collect();
    bound.push(&context.buffers.store);
    let group = context.bound(pipeline, &bound);
    let mut encoder = context.encoder();
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &group, &[]);
        let [x, y] = spread(index.active as u32);
        pass.dispatch_workgroups(x, y, 1);
    }
    context.queue.submit([encoder.finish()]);
    context.watchdog.check()
}

impl GpuTransform {
    /// Distance (metres) and gradient at each of `points` (N x 3, metres).
    pub(super) fn samples(&self, points: &[Point]) -> Result<Vec<Sample>, BackendError> {
        let mut samples = Vec::with_capacity(points.len());
        let record = self
            .device
            .context
            .filled(bytemuck::bytes_of(&self.record))?;
        for points in points.chunks(SAMPLED) {
            let context = &self.device.context;
            let offsets = context.filled(bytemuck::cast_slice(points))?;
            let bytes = points.len() as u64 * 16;
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
            let out = context.empty(bytes, usage)?;
            let pipeline = &context.kernels.sample;
            let group = context.bound(pipeline, &[&context.buffers.store, &offsets, &record, &out]);
            let mut encoder = context.encoder();
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, &group, &[]);
                pass.set_immediates(0, bytemuck::bytes_of(&layout::Part::default()));
                let [x, y] = spread(points.len().div_ceil(SAMPLE_GROUP) as u32);
                pass.dispatch_workgroups(x, y, 1);
            }
            let read = context.finish(encoder, &out, bytes)?;
            samples.extend(read.as_chunks::<16>().0.iter().map(|bytes| {
                let [x, y, z, distance]: [f32; 4] = bytemuck::pod_read_unaligned(bytes);
                Sample {
                    distance,
                    gradient: [x, y, z],
                }
            }));
        }
        Ok(samples)
    }
}

/// Marks an absent table or brick; `distance.wgsl` has the same constant.
const _: () = assert!(ABSENT == u32::MAX);
