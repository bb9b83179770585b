//! The fit of one pair on the GPU. Submissions with other pairs are in gpu/batcher.rs.

use core::ops::Range;
use std::sync::Arc;

use super::batcher::{Done, TileThroughput};
use super::context::Context;
use super::device::Device;
use super::layout::{ARRAYS, Arrays, CONVERGED, DIVERGED, STEPS, Status};
use super::linear::LinearFit;
use super::loss::{GpuLoss, GpuTarget};
use super::memory::NETWORK_BYTES;
use super::network::NetworkFit;
use super::request::{Kind, Model, Request};
use super::tiling::Cut;
use super::{inference, layout};
use crate::flow::data::{Control, Point, Progress, Random};
use crate::flow::field::{
    Advance, BackendError, Conditioning, EarlyStopState, FitReport, FittedField, GrowthState,
    LAID_OUT, LinearField, LinearGrid, Network, Parameters, Schedule, Trainer, TrainerState,
    check_state, mlp,
};
use crate::flow::options::{FieldOptions, ModelOptions, Precision};

/// Target duration of a submission, seconds. The control and the GPU's health are checked once per
/// submission.
const SUBMISSION_SECONDS: f64 = 0.03;
/// Iterations per submission if the GPU has no timestamps.
const BLIND_STEPS: usize = 4;
/// The most iterations of a submission, relative to the one before.
const GROWTH: usize = 4;
/// Maximum number of iterations per submission if a stopping rule may end the fit at any iteration.
const STOPPABLE_STEPS: usize = 16;

/// The model of a fit.
enum GpuModel {
    Network(NetworkFit),
    Linear(Arc<LinearFit>),
}

impl GpuModel {
    /// The model of a request.
    fn submitted(&self) -> Model {
        match self {
            Self::Network(network) => Model::Network(network.precision),
            Self::Linear(linear) => Model::Linear(Arc::clone(linear)),
        }
    }
}

/// The model, its optimizer and the prepared target.
pub(super) struct GpuTrainer<'a> {
    device: Arc<Device>,
    loss: GpuLoss<'a>,
    model: GpuModel,
    schedule: Schedule,
    cut: Cut,
    /// Offset of the points in the store, in words.
    points: u32,
    status: Status,
    /// The batch that nearest neighbors were searched for last.
    searched: Option<Range<usize>>,
    /// Speed of the latest submission whose first iteration had a query.
    pace: Option<TileThroughput>,
    /// Iterations of the latest submission.
    submitted: usize,
    /// The field of a linear model, if it was computed since the last iteration.
    decoded: Option<LinearField>,
    query_seconds: f64,
}

impl<'a> GpuTrainer<'a> {
    pub(super) fn new(
        target: GpuTarget<'a>,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Self, BackendError> {
        let device = Arc::clone(target.device());
        let loss = GpuLoss::new(target, &options.loss)?;
        if let Some(text) = options.lacks_gpu_kernels() {
            return Err(BackendError::Unsupported(text));
        }
        let mut random = Random::stream(seed, 0);
        let (model, parameters, schedule, cut) = match &options.model {
            ModelOptions::Network(network) => {
                if network.precision == Precision::F16 {
                    if !options.runs_in_half() {
                        let text = "half precision is for networks and distance transforms";
                        return Err(BackendError::Unsupported(text));
                    }
                    device.units()?;
                }
                let parameters = mlp::initial(network.start, &mut random);
                let schedule = Schedule::new(source, options, &mut random);
                let cut = Cut::new(schedule.largest_batch(GrowthState::default()));
                check_chunks(&device, cut)?;
                let conditioning = Conditioning::new(source, network.inputs);
                let model = NetworkFit::take(&device, conditioning, network.precision)?;
                (GpuModel::Network(model), parameters, schedule, cut)
            }
            ModelOptions::Linear(linear) => {
                let grid = LinearGrid::plan(source, linear)?;
                let mut parameters = Parameters::zeros(3 * grid.channel());
                grid.initial(&mut random, parameters.as_mut_slice());
                let schedule = Schedule::new(source, options, &mut random);
                let cut = Cut::one(schedule.largest_batch(GrowthState::default()));
                let (context, threads) = (&device.context, device.host.threads());
                let weight = linear.variation_weight;
                let model = LinearFit::new(context, threads, grid, weight, &schedule)?;
                (GpuModel::Linear(Arc::new(model)), parameters, schedule, cut)
            }
        };
        let mut trainer = Self {
            points: target.write_points(&schedule.points)?,
            device,
            loss,
            model,
            schedule,
            cut,
            status: Status::default(),
            searched: None,
            pace: None,
            submitted: 0,
            decoded: None,
            query_seconds: 0.0,
        };
        trainer.restore(TrainerState::at_start(parameters))?;
        Ok(trainer)
    }

    /// The lane's record, without the offsets of its tiles and chunks in a submission.
    fn lane(&self) -> layout::Lane {
        let rule = self.schedule.options.early_stop;
        let mut lane = layout::Lane {
            points: self.points,
            average: self.schedule.ema_weight(0).is_some().into(),
            patience: rule.map_or(0, |rule| rule.patience.max(1) as u32),
            min_delta: rule.map_or(0.0, |rule| rule.min_delta as f32),
            ..layout::Lane::default()
        };
        self.loss.describe(&mut lane);
        match &self.model {
            GpuModel::Network(network) => {
                lane.network = network.number();
                lane.parameters = LAID_OUT as u32 / 4;
                lane.center = network.conditioning.center;
                lane.scale = network.conditioning.scale;
            }
            GpuModel::Linear(linear) => lane.parameters = linear.quads(),
        }
        lane
    }

    /// The record of the iteration that follows `done` others. `searched` is the batch that nearest
    /// neighbors were searched for last.
    fn step(&self, done: usize, searched: &mut Option<Range<usize>>) -> layout::Step {
        let batch = self.schedule.batch(done, GrowthState::default());
        let adam = self.schedule.adam(done);
        let mut step = layout::Step {
            first: batch.start as u32,
            count: batch.len() as u32,
            weight: 1.0 / batch.len() as f32,
            step_size: adam.step_size,
            square_correction: adam.square_correction,
            ema_weight: self.schedule.ema_weight(done).unwrap_or(1.0),
            ..layout::Step::default()
        };
        self.loss.describe_step(&mut step, done, &batch, searched);
        step
    }

    /// The request for the next `steps` iterations. `searched` is the batch that nearest neighbors
    /// were searched for last, before the iterations and after them.
    fn request(&self, steps: usize, searched: &mut Option<Range<usize>>) -> Request {
        let done = self.status.iterations as usize;
        let steps = (done..done + steps).map(|done| self.step(done, searched));
        Request {
            lane: self.lane(),
            status: self.status,
            steps: steps.collect(),
            cut: self.cut,
            model: self.model.submitted(),
            loss: self.loss.kind(),
        }
    }

    /// The request for one iteration that can be repeated: its step size is zero.
    pub(super) fn repeated_iteration(&self) -> Request {
        let mut request = self.request(1, &mut None);
        request.steps[0].step_size = 0.0;
        request
    }

    /// Runs up to `steps` iterations in one submission.
    fn submit(&mut self, steps: usize, control: &dyn Control) -> Result<Done, BackendError> {
        let mut searched = self.searched.clone();
        let request = self.request(steps, &mut searched);
        let steps = request.steps.clone();
        let (device, batch) = (&self.device, &self.device.batch);
        let units = || device.units();
        let done = batch.run(&device.context, &units, request, control)?;
        self.submitted = steps.len();
        self.searched = searched;
        self.decoded = None;
        self.status = done.status;
        if self.loss.queries(&steps[..1]) > 0 {
            self.pace = done.pace.or(self.pace);
        }
        if let Some(pace) = self.pace {
            let queries = self.loss.queries(&steps[..done.losses.len()]);
            self.query_seconds += pace.tile_query * (self.cut.tiles * queries) as f64;
        }
        Ok(done)
    }

    /// The arrays of the fit, read from the GPU.
    fn read_arrays(&self) -> Result<[Parameters; ARRAYS], BackendError> {
        match &self.model {
            GpuModel::Network(network) => network.read(),
            GpuModel::Linear(linear) => linear.read(&self.device.context),
        }
    }

    /// The number of iterations for the next submission.
    fn stride(&self) -> usize {
        let pace = match Kind::new(&self.model.submitted(), self.loss.kind()).shares_pace() {
            true => self.device.batch.pace(),
            false => self.pace,
        };
        let seconds = pace.map(|pace| {
            let own = pace.tile * self.cut.tiles as f64;
            own.max(pace.iteration)
        });
        // Dispatched iterations after a stop have no effect.
        let most = match self.schedule.options.early_stop {
            Some(_) => STOPPABLE_STEPS,
            None => STEPS,
        };
        let most = most.min(GROWTH * self.submitted.max(1));
        match seconds {
            Some(seconds) => ((SUBMISSION_SECONDS / seconds.max(1e-6)) as usize).clamp(1, most),
            // The first submission measures the GPU's speed.
            None if self.device.context.tick.is_some() && self.submitted == 0 => 1,
            None => BLIND_STEPS,
        }
    }

    fn iterations(&self) -> usize {
        self.status.iterations as usize
    }
}

impl Trainer for GpuTrainer<'_> {
    fn advance(&mut self, steps: usize, control: &dyn Control) -> Result<Advance, BackendError> {
        let first = self.iterations();
        let most = self.schedule.options.max_iterations;
        loop {
            let done = self.iterations() - first;
            if self.iterations() >= most {
                return Ok(Advance::Exhausted);
            }
            if done >= steps {
                return Ok(Advance::Continues);
            }
            if let Some(interrupt) = control.interrupt() {
                return Ok(Advance::Interrupted(interrupt));
            }
            if done > 0 && control.snapshot_due() {
                return Ok(Advance::Continues);
            }
            let before = self.iterations();
            let steps = self.stride().min(steps - done).min(most - before);
            let steps = self.loss.up_to_a_search(before, steps);
            let submitted = match self.submit(steps, control) {
                Err(BackendError::Interrupted(interrupt)) => {
                    return Ok(Advance::Interrupted(interrupt));
                }
                submitted => submitted?,
            };
            for (iteration, &loss) in (before + 1..).zip(&submitted.losses) {
                control.progress(Progress {
                    done: iteration,
                    total: most,
                    loss: loss.into(),
                });
            }
            match self.status.state {
                CONVERGED => return Ok(Advance::Converged),
                DIVERGED => return Ok(Advance::Diverged),
                _ => {}
            }
        }
    }

    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        let context = &self.device.context;
        match &self.model {
            GpuModel::Network(_) => {
                let networks = &context.buffers.networks;
                inference::evaluate(context, networks, &self.lane(), points)
            }
            GpuModel::Linear(linear) => {
                let field = decoded(&mut self.decoded, linear, context)?;
                Ok(field.flow(points, self.device.host.threads()))
            }
        }
    }

    fn fitted(&mut self) -> Result<FittedField, BackendError> {
        Ok(match &self.model {
            GpuModel::Network(network) => {
                let [.., kept] = network.read()?;
                FittedField::Network(Network {
                    parameters: kept,
                    conditioning: network.conditioning,
                })
            }
            GpuModel::Linear(linear) => {
                let field = decoded(&mut self.decoded, linear, &self.device.context)?;
                FittedField::Linear(field.clone())
            }
        })
    }

    fn report(&self) -> FitReport {
        FitReport {
            iterations: self.iterations(),
            best_iteration: self.status.best_iteration as usize,
            best_loss: widened(self.status.best_loss).into(),
            query_seconds: self.query_seconds,
        }
    }

    fn state(&mut self) -> Result<Option<TrainerState>, BackendError> {
        let status = &self.status;
        if self.loss.depends_on_earlier(status.iterations as usize) {
            return Ok(None);
        }
        let [parameters, _, means, squares, kept] = self.read_arrays()?;
        Ok(Some(TrainerState {
            parameters,
            moments: [means, squares],
            kept,
            seen: EarlyStopState {
                best: (status.seen == 1).then_some(status.seen_best),
                without_progress: status.without_progress as usize,
            },
            iterations: status.iterations as usize,
            best_iteration: status.best_iteration as usize,
            growth: GrowthState::default(),
            best_loss: widened(status.best_loss),
        }))
    }

    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError> {
        let arrays = Arrays::of(&state);
        match &self.model {
            GpuModel::Network(network) => {
                check_state(&state, LAID_OUT)?;
                network.write(&arrays)?;
            }
            GpuModel::Linear(linear) => {
                check_state(&state, linear.floats())?;
                linear.write(&self.device.context, &arrays)?;
            }
        }
        self.searched = None;
        self.decoded = None;
        self.status = Status {
            iterations: state.iterations as u32,
            best_iteration: state.best_iteration as u32,
            best_loss: state.best_loss.min(f32::MAX),
            seen: state.seen.best.is_some().into(),
            seen_best: state.seen.best.unwrap_or_default(),
            without_progress: state.seen.without_progress as u32,
            ..Status::default()
        };
        self.device.context.watchdog.check()
    }

    fn shorten(&mut self, max_iterations: usize) {
        self.schedule.shorten(max_iterations);
    }
}

/// The field of the result of a linear model, computed if `known` has none.
fn decoded<'k>(
    known: &'k mut Option<LinearField>,
    linear: &LinearFit,
    context: &Context,
) -> Result<&'k LinearField, BackendError> {
    Ok(match known {
        Some(field) => field,
        None => known.insert(linear.field(context)?),
    })
}

/// Checks that the gradients of a batch fit into the GPU's memory.
fn check_chunks(device: &Device, cut: Cut) -> Result<(), BackendError> {
    let budget = &device.context.budget;
    let chunks = cut.chunks.count as u64;
    if chunks <= budget.chunks {
        return Ok(());
    }
    Err(BackendError::Memory {
        what: "gradients",
        needed: chunks * NETWORK_BYTES,
        available: budget.chunk_bytes(),
    })
}

/// On the GPU the largest finite float stands for infinity.
fn widened(loss: f32) -> f32 {
    if loss == f32::MAX {
        f32::INFINITY
    } else {
        loss
    }
}
