//! A network's flow at any points, on the card. Fits nothing.

use super::backend::{Card, spread};
use super::layout;
use super::layout::{ARRAYS, TILE};
use super::memory::NETWORK_BYTES;
use super::tiling::Cut;
use super::trainer::KEPT;
use crate::flow::data::Point;
use crate::flow::field::{BackendError, LAID_OUT, Network};

/// Points that are evaluated at a time.
const EVALUATED: usize = 1 << 18;

/// The flow at each of `points` that `network` says, metres.
pub(super) fn network(
    card: &Card,
    network: &Network,
    points: &[Point],
) -> Result<Vec<Point>, BackendError> {
    card.watchdog.check()?;
    let mut arrays = vec![0; ARRAYS * NETWORK_BYTES as usize];
    let kept = bytemuck::cast_slice(&network.parameters.as_slice()[..LAID_OUT]);
    arrays[(KEPT * NETWORK_BYTES) as usize..][..kept.len()].copy_from_slice(kept);
    let lane = layout::Lane {
        center: network.conditioning.center,
        scale: network.conditioning.scale,
        ..layout::Lane::default()
    };
    evaluate(card, &card.filled(&arrays)?, &lane, points)
}

/// The flow at each of `points` that the kept parameters of the lane's network say, metres.
pub(super) fn evaluate(
    card: &Card,
    networks: &wgpu::Buffer,
    lane: &layout::Lane,
    points: &[Point],
) -> Result<Vec<Point>, BackendError> {
    let mut flow = Vec::with_capacity(points.len());
    for points in points.chunks(EVALUATED) {
        flow.extend(evaluated(card, networks, lane, points)?);
    }
    Ok(flow)
}

/// As many points as fit into one dispatch.
fn evaluated(
    card: &Card,
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
    let places = card.filled(bytemuck::cast_slice(points))?;
    let lane = card.filled(bytemuck::bytes_of(&lane))?;
    let step = card.filled(bytemuck::bytes_of(&step))?;
    let list = card.filled(bytemuck::cast_slice(&list))?;
    let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
    let flows = card.empty((tiles * TILE * 16) as u64, usage)?;
    let pipeline = &card.kernels.evaluate;
    let buffers = &card.buffers;
    // An evaluation looks at no status and remembers no activations; the bindings are there.
    let group = card.bound(
        pipeline,
        &[
            &places,
            networks,
            &lane,
            &step,
            &list,
            &buffers.statuses,
            &flows,
            &buffers.activations,
        ],
    );
    let mut encoder = card.encoder();
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
    let read = card.finish(encoder, &flows, points.len() as u64 * 16)?;
    let rows = read.as_chunks::<16>().0.iter();
    Ok(rows
        .map(|bytes| {
            let [x, y, z, _]: [f32; 4] = bytemuck::pod_read_unaligned(bytes);
            [x, y, z]
        })
        .collect())
}
