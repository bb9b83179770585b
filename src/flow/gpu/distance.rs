//! A target's distance transform on the card: planned and its far field built by the host, its
//! bricks filled by the card.

use std::sync::Arc;

use super::backend::{Card, spread};
use super::layout;
use super::trainer::GpuTrainer;
use crate::flow::data::{Control, Point};
use crate::flow::distance::{
    ABSENT, CellSites, DistanceError, DistanceOptions, FarField, Index, Lattice, Layout, Metric,
    Sample, Sites, codes_per_cell,
};
use crate::flow::field::{BackendError, Trainer, Transform};
use crate::flow::options::Options;

/// Words of a brick's 16-bit codes.
const BRICK_WORDS: u64 = 256;
/// Words of a point.
const POINT_WORDS: u64 = 3;
/// Points that are sampled at a time.
const SAMPLED: usize = 1 << 20;
/// Points that a workgroup of `sample.wgsl` samples.
const SAMPLE_GROUP: usize = 64;

/// Words of the store that are a transform's, and its source points' behind them.
struct Allocation {
    card: Arc<Card>,
    place: u32,
    words: u64,
}

impl Allocation {
    fn take(card: &Arc<Card>, words: u64, control: &dyn Control) -> Result<Self, BackendError> {
        let place = card.words.take("distance transform", words, control)?;
        Ok(Self {
            card: Arc::clone(card),
            place: place as u32,
            words,
        })
    }
}

impl Drop for Allocation {
    fn drop(&mut self) {
        self.card.words.give_back(self.place.into(), self.words);
    }
}

/// A distance transform in the card's store.
pub(super) struct GpuTransform {
    pub(super) card: Arc<Card>,
    pub(super) record: layout::Transform,
    /// Words of the transform, before those of the points.
    words: u64,
    stretch: Allocation,
}

/// Transforms `target` over a grid that covers both clouds.
pub(super) fn build(
    card: &Arc<Card>,
    source: &[Point],
    target: &[Point],
    options: &DistanceOptions,
    control: &dyn Control,
) -> Result<GpuTransform, BackendError> {
    card.watchdog.check()?;
    if options.metric == Metric::Chamfer {
        let text = "the published chamfer metric is computed on the CPU alone";
        return Err(BackendError::Unsupported(text));
    }
    if options.sites == Sites::Points {
        let text = "distances to the points themselves are computed on the CPU alone";
        return Err(BackendError::Unsupported(text));
    }
    // On the host's threads, which nobody may keep while he waits for the card.
    let planned = card.host.threads().install(|| {
        let layout = Layout::plan(source, target, options, control)?;
        let band_m = f64::from(layout.band) * layout.grid.cell;
        let far = FarField::build(&layout.grid, &layout.cells, band_m, control)?;
        let sites = CellSites::new(&layout.cells, layout.band);
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
    let points = source.len() as u64 * POINT_WORDS;
    let stretch = Allocation::take(card, words + points, control)?;
    let mut place = u64::from(stretch.place);
    let places = parts.map(|words| {
        let own = place;
        place += words;
        own
    });
    let write = |place: u64, words: &[u8]| {
        card.queue
            .write_buffer(&card.buffers.store, place * 4, words);
    };
    write(places[0], bytemuck::cast_slice(&index.tables));
    write(places[1], bytemuck::cast_slice(&index.bricks));
    write(places[3], bytemuck::cast_slice(&far.distances));
    fill_bricks(card, &index, &sites, band, places[2] as u32)?;

    let lattice = Lattice::new(&grid);
    let record = layout::Transform {
        origin_high: lattice.origin_high,
        origin_low: lattice.origin_low,
        inverse_cell: lattice.inverse_cell,
        code_scale: (grid.cell / codes_per_cell(band)) as f32,
        vertices: lattice.vertices,
        blocks: index.blocks.map(|n| n as u32),
        tables: places[0] as u32,
        bricks: places[1] as u32,
        codes: places[2] as u32,
        far: places[3] as u32,
        far_pitch: far.pitch,
        far_vertices: far.vertices.map(|n| n as u32),
    };
    Ok(GpuTransform {
        card: Arc::clone(card),
        record,
        words,
        stretch,
    })
}

/// Has the card fill the active bricks.
fn fill_bricks(
    card: &Card,
    index: &Index,
    sites: &CellSites,
    band: i32,
    codes: u32,
) -> Result<(), BackendError> {
    if index.active == 0 {
        return Ok(());
    }
    let places: Vec<[u32; 3]> = index.active_places();
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
    let buffers = [
        card.filled(bytemuck::bytes_of(&plan))?,
        card.filled(bytemuck::cast_slice(&places))?,
        card.filled(bytemuck::cast_slice(sites.columns.starts()))?,
        card.filled(bytemuck::cast_slice(&columns))?,
        card.filled(bytemuck::cast_slice(&sites.squares))?,
        card.filled(bytemuck::cast_slice(&code_of))?,
    ];
    let pipeline = &card.kernels.bricks;
    let mut bound: Vec<_> = buffers.iter().collect();
    bound.push(&card.buffers.store);
    let group = card.bound(pipeline, &bound);
    let mut encoder = card.encoder();
    {
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &group, &[]);
        let [x, y] = spread(index.active as u32);
        pass.dispatch_workgroups(x, y, 1);
    }
    card.queue.submit([encoder.finish()]);
    card.watchdog.check()
}

impl GpuTransform {
    /// The place in the store of the points that are fitted, words: as many as the source that the
    /// transform was built for.
    pub(super) fn room_for(&self, points: usize) -> Result<u32, BackendError> {
        let (needed, available) = (points as u64 * POINT_WORDS, self.stretch.words - self.words);
        if needed > available {
            return Err(BackendError::Memory {
                what: "points",
                needed: needed * 4,
                available: available * 4,
            });
        }
        Ok(self.stretch.place + self.words as u32)
    }

    /// The transform at each of the points.
    pub(super) fn samples(&self, points: &[Point]) -> Result<Vec<Sample>, BackendError> {
        let mut samples = Vec::with_capacity(points.len());
        let record = self.card.filled(bytemuck::bytes_of(&self.record))?;
        for points in points.chunks(SAMPLED) {
            let card = &self.card;
            let places = card.filled(bytemuck::cast_slice(points))?;
            let bytes = points.len() as u64 * 16;
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC;
            let out = card.empty(bytes, usage)?;
            let pipeline = &card.kernels.sample;
            let group = card.bound(pipeline, &[&card.buffers.store, &places, &record, &out]);
            let mut encoder = card.encoder();
            {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                pass.set_pipeline(pipeline);
                pass.set_bind_group(0, &group, &[]);
                pass.set_immediates(0, bytemuck::bytes_of(&layout::Part::default()));
                let [x, y] = spread(points.len().div_ceil(SAMPLE_GROUP) as u32);
                pass.dispatch_workgroups(x, y, 1);
            }
            let read = card.finish(encoder, &out, bytes)?;
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

impl Transform for GpuTransform {
    fn bytes(&self) -> usize {
        self.words as usize * 4
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        let samples = self.samples(points)?;
        Ok(samples.into_iter().map(|sample| sample.distance).collect())
    }

    fn start(
        &self,
        source: &[Point],
        options: &Options,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        Ok(Box::new(GpuTrainer::new(self, source, options)?))
    }
}

/// Marks an absent table or brick; `distance.wgsl` has the same.
const _: () = assert!(ABSENT == u32::MAX);
