//! One iteration on the GPU: the order of its phases, and their bindings and dispatches.

use super::buffers::{Buffers, spread};
use super::chamfer_phases::ChamferPhases;
use super::context::Context;
use super::half::{HalfPhases, Units};
use super::layout::Part;
use super::linear::{LinearFit, LinearPhases};
use super::network_phases::NetworkPhases;
use super::phase::{Dispatch, Phase};
use super::request::{LossKind, Model, Request};
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
}

/// The loss of all lanes of a submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SubmittedLoss {
    Distance,
    /// The Chamfer distance, with the number of queries of the largest search.
    Chamfer {
        queries: usize,
    },
}

impl SubmittedLoss {
    /// The loss of `requests`, which go with each other.
    pub(super) fn of(requests: &[&Request]) -> Self {
        match requests.first().map(|request| request.loss) {
            Some(LossKind::Chamfer) => {
                let queries = requests.iter().map(|request| request.queries());
                Self::Chamfer {
                    queries: queries.max().unwrap_or_default(),
                }
            }
            _ => Self::Distance,
        }
    }
}

/// The phases of an iteration in order, each with its wave.
pub(super) struct Program {
    pub(super) before_query: Vec<(Phase, Wave)>,
    pub(super) query: Vec<(Phase, Wave)>,
    pub(super) after_query: Vec<(Phase, Wave)>,
    /// Share of all tiles whose query is in `query`.
    pub(super) query_share: f64,
}

impl Program {
    /// The phases of an iteration of `plan`. A search of nearest neighbors needs the flow of all
    /// waves, so with more than one wave the forward pass is done twice.
    pub(super) fn new(plan: &Plan, loss: SubmittedLoss) -> Self {
        let (first, rest) = (plan.waves[0], &plan.waves[1..]);
        let of_a_wave = |wave: &Wave| Phase::OF_A_WAVE.map(|phase| (phase, *wave));
        let others = rest.iter().flat_map(of_a_wave);
        let end = Phase::OF_THE_END.map(|phase| (phase, Wave::default()));
        match loss {
            SubmittedLoss::Distance => {
                let [forward, loss, backward, gradients] = of_a_wave(&first);
                let after = [backward, gradients].into_iter();
                Self {
                    before_query: vec![(Phase::Halve, first), forward],
                    query: vec![loss],
                    after_query: after.chain(others).chain(end).collect(),
                    query_share: first.tiles as f64 / plan.tiles.len() as f64,
                }
            }
            SubmittedLoss::Chamfer { .. } => {
                let displaced = plan.waves.iter();
                let displaced =
                    displaced.flat_map(|&wave| [(Phase::Forward, wave), (Phase::Deform, wave)]);
                let skipped = usize::from(rest.is_empty());
                let first_wave = of_a_wave(&first).into_iter().skip(skipped);
                Self {
                    before_query: vec![(Phase::Halve, first)],
                    query: displaced.chain([(Phase::Nearest, first)]).collect(),
                    after_query: first_wave.chain(others).chain(end).collect(),
                    query_share: 1.0,
                }
            }
        }
    }
}

/// The kernels of an iteration, bound to a submission's buffers.
pub(super) struct Phases<'a> {
    context: &'a Context,
    lanes: u32,
    /// Number of rows of a layer's activations.
    rows: u32,
    model: ModelPhases<'a>,
    /// Length of the model's array of parameters, in vec4s.
    parameters: u32,
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
        let tiles = &context.filled(bytemuck::cast_slice(&plan.tiles))?;
        let chunks = &context.filled(bytemuck::cast_slice(&plan.chunks))?;
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
        let own = match model {
            SubmittedModel::Linear(fit) => ModelBuffers {
                flows: &fit.flows,
                loss_gradients: &fit.loss_gradients,
                partials: &fit.gradients,
                arrays: &fit.arrays,
            },
            _ => ModelBuffers {
                flows: &buffers.flows,
                loss_gradients: &buffers.loss_gradients,
                partials: &buffers.partials,
                arrays: &buffers.networks,
            },
        };
        let loss_kernel = match loss {
            SubmittedLoss::Distance => &kernels.distance_loss,
            SubmittedLoss::Chamfer { .. } => &kernels.chamfer_loss,
        };
        Ok(Self {
            context,
            lanes: lanes as u32,
            rows: buffers.rows() as u32,
            parameters: match model {
                SubmittedModel::Linear(fit) => fit.quads(),
                _ => LAID_OUT as u32 / 4,
            },
            model: match model {
                SubmittedModel::Network => {
                    ModelPhases::Network(NetworkPhases::bind(context, buffers, [tiles, chunks]))
                }
                SubmittedModel::Half(units) => {
                    ModelPhases::Half(HalfPhases::bind(context, buffers, units, [tiles, chunks]))
                }
                SubmittedModel::Linear(fit) => {
                    ModelPhases::Linear(LinearPhases::bind(context, buffers, fit))
                }
            },
            loss: context.bound(
                loss_kernel,
                &[
                    store,
                    records,
                    steps,
                    tiles,
                    statuses,
                    own.flows,
                    own.loss_gradients,
                    tile_losses,
                ],
            ),
            chamfer: match loss {
                SubmittedLoss::Distance => None,
                SubmittedLoss::Chamfer { queries } => {
                    let phases = ChamferPhases::bind(context, buffers, [tiles, own.flows], queries);
                    Some(phases)
                }
            },
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
                let kernel = match self.chamfer {
                    None => &kernels.distance_loss,
                    Some(_) => &kernels.chamfer_loss,
                };
                vec![(kernel, &self.loss, spread(wave.tiles as u32))]
            }
            Phase::ReduceLoss => vec![(&kernels.reduce_loss, &self.reduce_loss, [self.lanes, 1])],
            Phase::Step => {
                let groups = self.parameters.div_ceil(STEP_GROUP);
                vec![(&kernels.step, &self.step, [groups, self.lanes])]
            }
        }
    }
}

/// Invocations per workgroup of `step.wgsl`.
const STEP_GROUP: u32 = 128;
