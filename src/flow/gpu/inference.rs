//! Evaluation of a network at arbitrary points on the GPU.

use super::buffers::spread;
use super::context::Context;
use super::layout;
use super::layout::{ARRAYS, KEPT, TILE};
use super::memory::NETWORK_BYTES;
use super::tiling::Cut;
use crate::flow::data::Point;
use crate::flow::field::{BackendError, LAID_OUT, Network};

/// Maximum number of points per dispatch.
const EVALUATED: usize = 1 << 18;

/// The flow (N x 3, metres) that `network` predicts at `points` (N x 3, metres).
pub(super) fn network(
    context: &Context,
    network: &Network,
    points: &[Point],
) -> Result<Vec<Point>, BackendError> {
    context.watchdog.check()?;
    let mut arrays = vec![0; ARRAYS * NETWORK_BYTES as usize];
    let kept = bytemuck::cast_slice(&network.parameters.as_slice()[..LAID_OUT]);
    arrays[(KEPT * NETWORK_BYTES) as usize..][..kept.len()].copy_from_slice(kept);
    let lane = layout::Lane {
        center: network.conditioning.center,
        scale: network.conditioning.scale,
        ..layout::Lane::default()
    };
    evaluate(context, &context.filled(&arrays)?, &lane, points)
}

/// The flow (N x 3, metres) that the kept parameters of the lane's network predict at `points` (N x
/// 3, metres).
pub(super) fn evaluate(
    context: &Context,
    networks: &wgpu::Buffer,
    lane: &layout::Lane,
    points: &[Point],
) -> Result<Vec<Point>, BackendError> {
    let mut flow = Vec::with_capacity(points.len());
    for points in points.chunks(EVALUATED) {
        flow.extend(evaluated(context, networks, lane, points)?);
    }
    Ok(flow)
}

/// Evaluates up to [`EVALUATED`] points in one dispatch.
fn evaluated(
    context: &Context,
    networks: &wgpu::Buffer,
    lane: &layout::Lane,
    points: &[Point],
) -> Result<Vec<Point>, BackendError> {
    let lane = layout::Lane { points: 0, ..*lane };
    let step = layout::Step {
        count: points.len() as u32,
        ..layout::Step::default()
    };
    let tiles = Cut::new(points.len()).tiles;
    let list: Vec<_> = (0..tiles as u32)
        .map(|tile| layout::Tile { lane: 0, tile })
        .collect();
    let [indices, lane, step, list] = context.all_filled([
        bytemuck::cast_slice(points),
        bytemuck::bytes_of(&lane),
        bytemuck::bytes_of(&step),
        bytemuck::cast_slice(&list),
    ])?;
    let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
    let flows = context.empty((tiles * TILE * 16) as u64, usage)?;
    let pipeline = &context.kernels.evaluate;
    let buffers = &context.buffers;
    // The evaluation reads no status and writes no activations, but the bindings must be present.
    let group = context.bound(
        pipeline,
        &[
            &indices,
            networks,
            &lane,
            &step,
            &list,
            &buffers.statuses,
            &flows,
            &buffers.activations,
        ],
    );
    let mut encoder = context.encoder();
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &group, &[]);
        let part = layout::Part {
            tiles: tiles as u32,
            ..layout::Part::default()
        };
        pass.set_immediates(0, bytemuck::bytes_of(&part));
        let [x, y] = spread(tiles as u32);
        pass.dispatch_workgroups(x, y, 1);
    }
    let read = context.finish(encoder, &flows, points.len() as u64 * 16)?;
    let rows = read.as_chunks::<16>().0.iter();
    Ok(rows
        .map(|bytes| {
            let [x, y, z, _]: [f32; 4] = bytemuck::pod_read_unaligned(bytes);
            [x, y, z]
        })
        .collect())
}
