//! One iteration on the GPU: the bindings and dispatches of its phases.

use super::buffers::{Buffers, MOST_GROUPS, spread};
use super::chamfer_phases::ChamferPhases;
use super::context::Context;
use super::half::{HalfPhases, Units};
use super::layout::Part;
use super::linear::{LinearFit, LinearPhases};
use super::network_phases::NetworkPhases;
use super::phase::{Dispatch, Phase};
use super::program::SubmittedLoss;
use super::request::Model;
use super::tiling::{Plan, Wave};
use crate::flow::field::{BackendError, LAID_OUT};
use crate::flow::options::Precision;

/// The model of all lanes of a submission.
#[derive(Clone, Copy)]
pub(super) enum SubmittedModel<'a> {
    /// Networks in single precision.
    Network,
    /// Networks in half precision.
    Half(&'a Units),
    /// One linear model.
    Linear(&'a LinearFit),
}

impl<'a> SubmittedModel<'a> {
    /// The model of a request. `units` are the kernels of half precision.
    ///
    /// # Errors
    /// Those of `units`.
    pub(super) fn of<'u: 'a>(
        model: &'a Model,
        units: &dyn Fn() -> Result<&'u Units, BackendError>,
    ) -> Result<Self, BackendError> {
        Ok(match model {
            Model::Network(Precision::F32) => Self::Network,
            Model::Network(Precision::F16) => Self::Half(units()?),
            Model::Linear(fit) => Self::Linear(fit),
        })
    }

    /// Length of an array of parameters, in vec4s.
    fn parameters(self) -> u32 {
        match self {
            Self::Network | Self::Half(_) => LAID_OUT as u32 / 4,
            Self::Linear(fit) => fit.quads(),
        }
    }

    /// Where the model keeps what the common kernels read and write.
    fn buffers<'b>(self, common: &'b Buffers) -> ModelBuffers<'b>
    where
        'a: 'b,
    {
        match self {
            Self::Network | Self::Half(_) => ModelBuffers {
                flows: &common.flows,
                loss_gradients: &common.loss_gradients,
                partials: &common.partials,
                arrays: &common.networks,
            },
            Self::Linear(fit) => ModelBuffers {
                flows: &fit.flows,
                loss_gradients: &fit.loss_gradients,
                partials: &fit.gradients,
                arrays: &fit.arrays,
            },
        }
    }

    /// The kernels of the model.
    fn bound(
        self,
        context: &'a Context,
        buffers: &Buffers,
        records: [&wgpu::Buffer; 2],
    ) -> ModelPhases<'a> {
        match self {
            Self::Network => ModelPhases::Network(NetworkPhases::bind(context, buffers, records)),
            Self::Half(units) => {
                ModelPhases::Half(HalfPhases::bind(context, buffers, units, records))
            }
            Self::Linear(fit) => ModelPhases::Linear(LinearPhases::bind(context, buffers, fit)),
        }
    }
}

/// The kernels of an iteration, bound to a submission's buffers.
pub(super) struct Phases<'a> {
    pub(super) context: &'a Context,
    lanes: u32,
    /// Number of rows of a layer's activations.
    rows: u32,
    model: ModelPhases<'a>,
    /// Length of the model's array of parameters, in vec4s.
    parameters: u32,
    loss_kernel: &'a wgpu::ComputePipeline,
    loss: wgpu::BindGroup,
    chamfer: Option<ChamferPhases<'a>>,
    reduce_loss: wgpu::BindGroup,
    step: wgpu::BindGroup,
}

/// The kernels of the model.
enum ModelPhases<'a> {
    Network(NetworkPhases<'a>),
    Half(HalfPhases<'a>),
    Linear(LinearPhases<'a>),
}

/// Where the model keeps what the common kernels read and write.
struct ModelBuffers<'a> {
    flows: &'a wgpu::Buffer,
    loss_gradients: &'a wgpu::Buffer,
    partials: &'a wgpu::Buffer,
    arrays: &'a wgpu::Buffer,
}

impl<'a> Phases<'a> {
    /// Binds the kernels for a submission of `lanes` lanes.
    ///
    /// # Errors
    /// [`BackendError::Busy`] if the GPU has no free memory for the plan now.
    pub(super) fn bind(
        context: &'a Context,
        buffers: &Buffers,
        plan: &Plan,
        lanes: usize,
        model: SubmittedModel<'a>,
        loss: SubmittedLoss,
    ) -> Result<Self, BackendError> {
        let [tiles, chunks] = &context.all_filled([
            bytemuck::cast_slice(&plan.tiles),
            bytemuck::cast_slice(&plan.chunks),
        ])?;
        let storage = wgpu::BufferUsages::STORAGE;
        let tile_losses = &context.empty(plan.tiles.len() as u64 * 4, storage)?;
        let kernels = &context.kernels;
        let Buffers {
            store,
            lanes: records,
            steps,
            statuses,
            losses,
            ..
        } = buffers;
        let own = model.buffers(buffers);
        let read = [store, records, steps, tiles, statuses, own.flows];
        let written = [own.loss_gradients, tile_losses];
        let loss_kernel = match loss {
            SubmittedLoss::Distance => &kernels.distance_loss,
            SubmittedLoss::Chamfer { .. } => &kernels.chamfer_loss,
        };
        let has_search = loss != SubmittedLoss::Distance;
        Ok(Self {
            context,
            lanes: lanes as u32,
            rows: buffers.rows() as u32,
            parameters: model.parameters(),
            model: model.bound(context, buffers, [tiles, chunks]),
            loss_kernel,
            loss: context.bound(loss_kernel, &[&read[..], &written].concat()),
            chamfer: has_search.then(|| ChamferPhases::bind(context, buffers, [tiles, own.flows])),
            reduce_loss: context.bound(
                &kernels.reduce_loss,
                &[records, steps, tile_losses, statuses, losses],
            ),
            step: context.bound(
                &kernels.step,
                &[records, steps, statuses, own.partials, own.arrays],
            ),
        })
    }

    /// Dispatches one phase of iteration `step`; those that work by waves, over `wave`.
    pub(super) fn dispatch(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        phase: Phase,
        step: usize,
        wave: &Wave,
    ) {
        for (pipeline, group, [x, y]) in self.dispatches(phase, wave) {
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, group, &[]);
            if !matches!(phase, Phase::Halve | Phase::Transpose) {
                let part = Part {
                    step: step as u32,
                    first_tile: wave.first_tile as u32,
                    first_chunk: wave.first_chunk as u32,
                    tiles: wave.tiles as u32,
                    first_row: wave.first_row as u32,
                    rows: self.rows,
                    nothing: 0,
                };
                pass.set_immediates(0, bytemuck::bytes_of(&part));
            }
            pass.dispatch_workgroups(x, y, 1);
        }
    }

    /// The dispatches of a phase, none if the model or the loss lacks it.
    fn dispatches(&self, phase: Phase, wave: &Wave) -> Vec<Dispatch<'_>> {
        let kernels = &self.context.kernels;
        match phase {
            Phase::Halve
            | Phase::Forward
            | Phase::Backward
            | Phase::Gradients
            | Phase::Transpose => match &self.model {
                ModelPhases::Network(model) => model.dispatches(phase, wave, self.lanes),
                ModelPhases::Half(model) => model.dispatches(phase, wave, self.lanes),
                ModelPhases::Linear(model) => model.dispatches(phase),
            },
            Phase::Deform | Phase::Nearest => {
                let chamfer = self.chamfer.iter();
                chamfer
                    .map(|chamfer| chamfer.dispatch(phase, wave, self.lanes))
                    .collect()
            }
            Phase::Loss => {
                let groups = spread(wave.tiles as u32);
                vec![(self.loss_kernel, &self.loss, groups)]
            }
            Phase::ReduceLoss => vec![(&kernels.reduce_loss, &self.reduce_loss, [self.lanes, 1])],
            Phase::Step => {
                let groups = self.parameters.div_ceil(STEP_GROUP).min(MOST_GROUPS);
                vec![(&kernels.step, &self.step, [groups, self.lanes])]
            }
        }
    }
}

/// Invocations per workgroup of `step.wgsl`.
const STEP_GROUP: u32 = 128;
