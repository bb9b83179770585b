//! One iteration on the GPU: its kernels, their bindings and their dispatches.

use super::buffers::{Buffers, spread};
use super::context::Context;
use super::half::{HalfPhases, Units};
use super::layout::Part;
use super::phase::{Dispatch, Phase};
use super::tiling::{Plan, Wave};
use crate::flow::field::{BackendError, LAID_OUT, MIDDLE_LAYERS};

/// The kernels of an iteration, bound to a submission's buffers.
pub(super) struct Phases<'a> {
    context: &'a Context,
    lanes: u32,
    /// Number of rows of a layer's activations.
    rows: u32,
    forward: wgpu::BindGroup,
    distance_loss: wgpu::BindGroup,
    backward: wgpu::BindGroup,
    gradients: wgpu::BindGroup,
    reduce_loss: wgpu::BindGroup,
    step: wgpu::BindGroup,
    transpose: wgpu::BindGroup,
    half: Option<HalfPhases<'a>>,
}

impl<'a> Phases<'a> {
    /// Binds the kernels for a submission of `lanes` lanes. With `units`, half precision is used.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if the GPU has no free memory for the plan now.
    pub(super) fn bind(
        context: &'a Context,
        buffers: &Buffers,
        plan: &Plan,
        lanes: usize,
        units: Option<&'a Units>,
    ) -> Result<Self, BackendError> {
        let tiles = &context.filled(bytemuck::cast_slice(&plan.tiles))?;
        let chunks = &context.filled(bytemuck::cast_slice(&plan.chunks))?;
        let storage = wgpu::BufferUsages::STORAGE;
        let tile_losses = &context.empty(plan.tiles.len() as u64 * 4, storage)?;
        let Buffers {
            networks,
            partials,
            lanes: records,
            steps,
            statuses,
            losses,
            ..
        } = buffers;
        let [forward, distance_loss, backward, gradients] =
            bind_wave(context, buffers, [tiles, chunks, tile_losses]);
        let half = units.map(|units| HalfPhases::bind(context, buffers, units, [tiles, chunks]));
        let kernels = &context.kernels;
        Ok(Self {
            context,
            lanes: lanes as u32,
            rows: buffers.rows() as u32,
            forward,
            distance_loss,
            backward,
            gradients,
            reduce_loss: context.bound(
                &kernels.reduce_loss,
                &[records, steps, tile_losses, statuses, losses],
            ),
            step: context.bound(
                &kernels.step,
                &[records, steps, statuses, partials, networks],
            ),
            transpose: context.bound(&kernels.transpose, &[statuses, records, networks]),
            half,
        })
    }

    /// Dispatches one kernel of iteration `step`; the kernels that work by waves, over `wave`.
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

    /// The dispatch of a phase in single precision.
    fn dispatches(&self, phase: Phase, wave: &Wave) -> Option<Dispatch<'_>> {
        let kernels = &self.context.kernels;
        let tiles = spread(wave.tiles as u32);
        Some(match phase {
            Phase::Halve => return None,
            Phase::Forward => (&kernels.forward, &self.forward, tiles),
            Phase::DistanceLoss => (&kernels.distance_loss, &self.distance_loss, tiles),
            Phase::Backward => (&kernels.backward, &self.backward, tiles),
            Phase::Gradients => {
                let layers = MIDDLE_LAYERS as u32 + 2;
                let groups = [wave.chunks as u32, layers];
                (&kernels.gradients, &self.gradients, groups)
            }
            Phase::ReduceLoss => (&kernels.reduce_loss, &self.reduce_loss, [self.lanes, 1]),
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

/// Invocations per workgroup of `step.wgsl`.
const STEP_GROUP: u32 = 128;
/// Squares of 32 x 32 weights per layer, see `transpose.wgsl`.
const SQUARES: u32 = 16;

/// The bindings of the kernels that run for each wave: forward, distance_loss, backward and gradients.
fn bind_wave(
    context: &Context,
    buffers: &Buffers,
    [tiles, chunks, tile_losses]: [&wgpu::Buffer; 3],
) -> [wgpu::BindGroup; 4] {
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
        ..
    } = buffers;
    let kernels = &context.kernels;
    [
        context.bound(
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
        context.bound(
            &kernels.distance_loss,
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
        context.bound(
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
        context.bound(
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
    ]
}
