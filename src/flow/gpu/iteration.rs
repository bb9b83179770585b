//! One iteration as the card does it: the kernels in their order, what each is bound to, and the
//! card's own clock over them. Knows neither pairs nor stopping rules.

use super::backend::{Buffers, Card, spread};
use super::half::{HalfPhases, Units};
use super::layout::Part;
use super::tiling::{Plan, Wave};
use crate::flow::field::{BackendError, LAID_OUT, MIDDLE_LAYERS};

/// A kernel of an iteration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// Of half precision alone: the weights that the others read, before the first wave.
    Halve,
    Forward,
    Query,
    Backward,
    Gradients,
    Judge,
    Step,
    /// Of single precision alone.
    Transpose,
}

/// A dispatch: its kernel, what that is bound to, and workgroups in two dimensions.
pub(super) type Dispatch<'a> = (&'a wgpu::ComputePipeline, &'a wgpu::BindGroup, [u32; 2]);

impl Phase {
    /// What is done for each wave of points, in order.
    pub(super) const OF_A_WAVE: [Self; 4] =
        [Self::Forward, Self::Query, Self::Backward, Self::Gradients];
    /// What is done once all waves are, in order.
    pub(super) const OF_THE_END: [Self; 3] = [Self::Judge, Self::Step, Self::Transpose];
}

/// The kernels of a submission, bound to its buffers.
pub(super) struct Phases<'a> {
    card: &'a Card,
    lanes: u32,
    /// Rows of a layer's activations.
    rows: u32,
    forward: wgpu::BindGroup,
    query: wgpu::BindGroup,
    backward: wgpu::BindGroup,
    gradients: wgpu::BindGroup,
    judge: wgpu::BindGroup,
    step: wgpu::BindGroup,
    transpose: wgpu::BindGroup,
    half: Option<HalfPhases<'a>>,
}

impl<'a> Phases<'a> {
    /// Binds the kernels for a submission of `lanes` lanes; with matrix units, in half precision.
    ///
    /// # Errors
    /// [`BackendError::Busy`] where the card has no room for the plan now.
    pub(super) fn bind(
        card: &'a Card,
        buffers: &Buffers,
        plan: &Plan,
        lanes: usize,
        units: Option<&'a Units>,
    ) -> Result<Self, BackendError> {
        let tiles = &card.filled(bytemuck::cast_slice(&plan.tiles))?;
        let chunks = &card.filled(bytemuck::cast_slice(&plan.chunks))?;
        let storage = wgpu::BufferUsages::STORAGE;
        let tile_losses = &card.empty(plan.tiles.len() as u64 * 4, storage)?;
        let Buffers {
            store,
            networks,
            activations,
            deltas,
            flows,
            loss_gradients,
            partials,
            lanes: records,
            steps,
            statuses,
            losses,
        } = buffers;
        let half = units.map(|units| HalfPhases::bind(card, buffers, units, tiles, chunks));
        let kernels = &card.kernels;
        Ok(Self {
            card,
            lanes: lanes as u32,
            rows: buffers.rows() as u32,
            forward: card.bound(
                &kernels.forward,
                &[
                    store,
                    networks,
                    records,
                    steps,
                    tiles,
                    statuses,
                    flows,
                    activations,
                ],
            ),
            query: card.bound(
                &kernels.query,
                &[
                    store,
                    records,
                    steps,
                    tiles,
                    statuses,
                    flows,
                    loss_gradients,
                    tile_losses,
                ],
            ),
            backward: card.bound(
                &kernels.backward,
                &[
                    networks,
                    tiles,
                    statuses,
                    loss_gradients,
                    activations,
                    records,
                    deltas,
                ],
            ),
            gradients: card.bound(
                &kernels.gradients,
                &[
                    store,
                    records,
                    steps,
                    chunks,
                    statuses,
                    activations,
                    deltas,
                    loss_gradients,
                    partials,
                ],
            ),
            judge: card.bound(
                &kernels.judge,
                &[records, steps, tile_losses, statuses, losses],
            ),
            step: card.bound(
                &kernels.step,
                &[records, steps, statuses, partials, networks],
            ),
            transpose: card.bound(&kernels.transpose, &[statuses, records, networks]),
            half,
        })
    }

    /// Does one kernel of iteration `step`, over `wave` where it goes by waves.
    pub(super) fn dispatch(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        phase: Phase,
        step: usize,
        wave: &Wave,
    ) {
        let half = self.half.as_ref();
        let half = half.and_then(|half| half.dispatches(phase, wave, self.lanes));
        let own = || self.dispatches(phase, wave).into_iter().collect();
        for (pipeline, group, [x, y]) in half.unwrap_or_else(own) {
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, group, &[]);
            if !matches!(phase, Phase::Halve | Phase::Transpose) {
                let part = Part {
                    step: step as u32,
                    first_tile: wave.first_tile as u32,
                    first_chunk: wave.first_chunk as u32,
                    tiles: wave.tiles as u32,
                    rows: self.rows,
                    nothing: 0,
                };
                pass.set_immediates(0, bytemuck::bytes_of(&part));
            }
            pass.dispatch_workgroups(x, y, 1);
        }
    }

    /// What is dispatched in single precision.
    fn dispatches(&self, phase: Phase, wave: &Wave) -> Option<Dispatch<'_>> {
        let kernels = &self.card.kernels;
        let tiles = spread(wave.tiles as u32);
        Some(match phase {
            Phase::Halve => return None,
            Phase::Forward => (&kernels.forward, &self.forward, tiles),
            Phase::Query => (&kernels.query, &self.query, tiles),
            Phase::Backward => (&kernels.backward, &self.backward, tiles),
            Phase::Gradients => {
                let layers = MIDDLE_LAYERS as u32 + 2;
                let groups = [wave.chunks as u32, layers];
                (&kernels.gradients, &self.gradients, groups)
            }
            Phase::Judge => (&kernels.judge, &self.judge, [self.lanes, 1]),
            Phase::Step => {
                let groups = (LAID_OUT as u32 / 4).div_ceil(STEP_GROUP);
                (&kernels.step, &self.step, [groups, self.lanes])
            }
            Phase::Transpose => {
                let squares = MIDDLE_LAYERS as u32 * SQUARES;
                (&kernels.transpose, &self.transpose, [squares, self.lanes])
            }
        })
    }
}

/// Invocations of a workgroup of `step.wgsl`.
const STEP_GROUP: u32 = 128;
/// Squares of 32 x 32 weights of a layer, see `transpose.wgsl`.
const SQUARES: u32 = 16;

/// Moments of the card's own clock.
pub(super) struct Clock {
    set: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    moments: u32,
    tick: f64,
}

impl Clock {
    /// A clock that notes so many moments; none where the card shows no time.
    pub(super) fn new(card: &Card, moments: u32) -> Option<Self> {
        let tick = card.tick?;
        let set = card.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: None,
            ty: wgpu::QueryType::Timestamp,
            count: moments,
        });
        let resolved = card.device.create_buffer(&wgpu::BufferDescriptor {
            label: None,
            size: u64::from(moments) * 8,
            usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        Some(Self {
            set,
            resolved,
            moments,
            tick,
        })
    }

    /// A pass whose begin and end are noted in these places.
    pub(super) fn pass<'a>(
        &self,
        encoder: &'a mut wgpu::CommandEncoder,
        begin: Option<u32>,
        end: Option<u32>,
    ) -> wgpu::ComputePass<'a> {
        encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
            label: None,
            timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                query_set: &self.set,
                beginning_of_pass_write_index: begin,
                end_of_pass_write_index: end,
            }),
        })
    }

    /// Writes the moments, eight bytes each, to `to` from `at` on.
    pub(super) fn resolve(&self, encoder: &mut wgpu::CommandEncoder, to: &wgpu::Buffer, at: u64) {
        encoder.resolve_query_set(&self.set, 0..self.moments, &self.resolved, 0);
        let bytes = u64::from(self.moments) * 8;
        encoder.copy_buffer_to_buffer(&self.resolved, 0, to, at, bytes);
    }

    /// Seconds between two moments of those that [`Self::resolve`] wrote.
    pub(super) fn seconds(&self, moments: &[u8], from: usize, to: usize) -> f64 {
        let at = |place: usize| u64::from_ne_bytes(moments.as_chunks::<8>().0[place]);
        at(to).saturating_sub(at(from)) as f64 * self.tick
    }
}
