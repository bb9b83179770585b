//! The fit of one pair on the GPU. Submissions with other pairs are in gpu/batcher.rs.

use std::sync::Arc;

use super::batcher::Done;
use super::device::Device;
use super::distance::GpuTransform;
use super::layout::{
    ARRAYS, CONVERGED, DIVERGED, KEPT, MEANS, PARAMETERS, SQUARES, STEPS, Status, TRANSPOSED,
};
use super::memory::NETWORK_BYTES;
use super::request::Request;
use super::tiling::Cut;
use super::{inference, layout};
use crate::flow::data::{Control, Point, Progress, Random};
use crate::flow::field::Network as FittedNetwork;
use crate::flow::field::{
    Advance, BackendError, Conditioning, EarlyStopState, FitReport, FittedField, GrowthState,
    LAID_OUT, Parameters, Schedule, Trainer, TrainerState, check_state, mlp,
    transpose_middle_layers,
};
use crate::flow::options::{DistanceLossOptions, FieldOptions, Precision};

/// The error of a fit to a Chamfer distance.
pub(super) const NO_CHAMFER: BackendError =
    BackendError::Unsupported("the Chamfer distance is computed on the CPU alone");

/// The error of a fit of the linear model.
const NO_LINEAR_MODEL: BackendError =
    BackendError::Unsupported("the linear model is computed on the CPU alone");

/// The error of a fit with a cycle.
const NO_CYCLE: BackendError =
    BackendError::Unsupported("the cycle of two networks is computed on the CPU alone");

/// The error of a fit with a growing batch.
const NO_GROWTH: BackendError = BackendError::Unsupported("batches grow on the CPU alone");

/// The error of a fit in bird's eye view.
const NO_BEV: BackendError =
    BackendError::Unsupported("the bird's eye view is computed on the CPU alone");

/// The growth of a constant batch.
const CONSTANT: GrowthState = GrowthState {
    doublings: 0,
    loss: None,
};

/// Target duration of a submission, seconds. The control and the GPU's health are checked once per
/// submission.
const SUBMISSION_SECONDS: f64 = 0.03;
/// Iterations per submission if the GPU has no timestamps.
const BLIND_STEPS: usize = 4;
/// Maximum number of iterations per submission if a stopping rule may end the fit at any iteration.
const STOPPABLE_STEPS: usize = 16;
/// A network slot of the GPU. Released on drop.
struct Network {
    device: Arc<Device>,
    number: u32,
}

impl Network {
    fn take(device: &Arc<Device>) -> Result<Self, BackendError> {
        let number = device.context.take_network()?;
        device.batch.joined();
        Ok(Self {
            device: Arc::clone(device),
            number,
        })
    }

    /// Byte offset of one of the slot's arrays.
    fn at(&self, array: u64) -> u64 {
        (u64::from(self.number) * ARRAYS as u64 + array) * NETWORK_BYTES
    }

    fn write(&self, array: u64, parameters: &Parameters) {
        let bytes = bytemuck::cast_slice(&parameters.as_slice()[..LAID_OUT]);
        let queue = &self.device.context.queue;
        queue.write_buffer(&self.device.context.buffers.networks, self.at(array), bytes);
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        self.device.batch.left();
        self.device.context.give_network_back(self.number);
    }
}

/// The network, its optimizer and the distance transform of the target.
pub(super) struct GpuTrainer<'a> {
    transform: &'a GpuTransform,
    precision: Precision,
    loss: DistanceLossOptions,
    conditioning: Conditioning,
    schedule: Schedule,
    cut: Cut,
    network: Network,
    /// Offset of the points in the store, in words.
    points: u32,
    status: Status,
    query_seconds: f64,
}

impl<'a> GpuTrainer<'a> {
    pub(super) fn new(
        transform: &'a GpuTransform,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Self, BackendError> {
        let device = &transform.device;
        let loss = options.loss.distance().ok_or(NO_CHAMFER)?.clone();
        let model = *options.network().ok_or(NO_LINEAR_MODEL)?;
        if model.cycle {
            return Err(NO_CYCLE);
        }
        if options.growth.is_some() {
            return Err(NO_GROWTH);
        }
        if options.bev {
            return Err(NO_BEV);
        }
        if model.precision == Precision::F16 {
            device.units()?;
        }
        let mut random = Random::stream(seed, 0);
        let parameters = mlp::initial(model.start, &mut random);
        let schedule = Schedule::new(source, options, &mut random);
        let cut = Cut::new(schedule.largest_batch(CONSTANT));
        let chunks = cut.chunks.count as u64;
        if chunks > device.context.budget.chunks {
            return Err(BackendError::Memory {
                what: "gradients",
                needed: chunks * NETWORK_BYTES,
                available: device.context.budget.chunk_bytes(),
            });
        }
        let points = transform.room_for(schedule.points.len())?;
        let at = u64::from(points) * 4;
        let bytes = bytemuck::cast_slice(&schedule.points);
        device
            .context
            .queue
            .write_buffer(&device.context.buffers.store, at, bytes);
        let mut trainer = Self {
            transform,
            precision: model.precision,
            loss,
            network: Network::take(device)?,
            conditioning: Conditioning::new(source, model.inputs),
            schedule,
            cut,
            points,
            status: Status::default(),
            query_seconds: 0.0,
        };
        trainer.restore(TrainerState::at_start(parameters))?;
        Ok(trainer)
    }

    fn device(&self) -> &Arc<Device> {
        &self.transform.device
    }

    /// The lane's record, without the offsets of its tiles and chunks in a submission.
    pub(super) fn lane(&self) -> layout::Lane {
        let (loss, rule) = (&self.loss, self.schedule.options.early_stop);
        layout::Lane {
            transform: self.transform.record,
            network: self.network.number,
            points: self.points,
            center: self.conditioning.center,
            scale: self.conditioning.scale,
            margin: loss.margin_m,
            margin_slope: loss.margin_slope,
            truncation: loss.truncation_m.unwrap_or(f32::MAX),
            flow_penalty: loss.flow_penalty,
            average: self.schedule.ema_weight(0).is_some().into(),
            patience: rule.map_or(0, |rule| rule.patience.max(1) as u32),
            min_delta: rule.map_or(0.0, |rule| rule.min_delta as f32),
            ..layout::Lane::default()
        }
    }

    /// The record of the iteration that follows `done` others.
    fn step(&self, done: usize) -> layout::Step {
        let batch = self.schedule.batch(done, CONSTANT);
        let adam = self.schedule.adam(done);
        layout::Step {
            first: batch.start as u32,
            count: batch.len() as u32,
            weight: 1.0 / batch.len() as f32,
            step_size: adam.step_size,
            square_correction: adam.square_correction,
            ema_weight: self.schedule.ema_weight(done).unwrap_or(1.0),
        }
    }

    /// Runs up to `steps` iterations in one submission.
    fn submit(&mut self, steps: usize) -> Result<Done, BackendError> {
        let done = self.status.iterations as usize;
        let request = Request {
            lane: self.lane(),
            status: self.status,
            steps: (done..done + steps).map(|done| self.step(done)).collect(),
            cut: self.cut,
            precision: self.precision,
        };
        let done = {
            let device = self.device();
            let units = || device.units();
            device.batch.run(&device.context, &units, request)?
        };
        self.status = done.status;
        if let Some(pace) = done.pace {
            let tiles = self.cut.tiles * done.losses.len();
            self.query_seconds += pace.tile_query * tiles as f64;
        }
        Ok(done)
    }

    /// The state, read from the GPU.
    fn read_state(&mut self) -> Result<TrainerState, BackendError> {
        let context = &self.device().context;
        let bytes = ARRAYS as u64 * NETWORK_BYTES;
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let copy = context.empty(bytes, usage)?;
        let mut encoder = context.encoder();
        let from = self.network.at(PARAMETERS);
        encoder.copy_buffer_to_buffer(&context.buffers.networks, from, &copy, 0, bytes);
        let read = context.finish(encoder, &copy, bytes)?;
        let array = |array: u64| {
            let mut parameters = mlp::zeros();
            let from = (array * NETWORK_BYTES) as usize;
            let bytes = &read[from..from + NETWORK_BYTES as usize];
            bytemuck::cast_slice_mut::<f32, u8>(&mut parameters.as_mut_slice()[..LAID_OUT])
                .copy_from_slice(bytes);
            parameters
        };
        let status = &self.status;
        Ok(TrainerState {
            parameters: array(PARAMETERS),
            moments: [array(MEANS), array(SQUARES)],
            kept: array(KEPT),
            seen: EarlyStopState {
                best: (status.seen == 1).then_some(status.seen_best),
                without_progress: status.without_progress as usize,
            },
            iterations: status.iterations as usize,
            best_iteration: status.best_iteration as usize,
            growth: CONSTANT,
            best_loss: widened(status.best_loss),
        })
    }

    /// The number of iterations for the next submission.
    fn stride(&self) -> usize {
        let seconds = self.device().batch.pace().map(|pace| {
            let own = pace.tile * self.cut.tiles as f64;
            own.max(pace.iteration)
        });
        // Dispatched iterations after a stop have no effect.
        let most = match self.schedule.options.early_stop {
            Some(_) => STOPPABLE_STEPS,
            None => STEPS,
        };
        match seconds {
            Some(seconds) => ((SUBMISSION_SECONDS / seconds.max(1e-6)) as usize).clamp(1, most),
            // The first submission measures the GPU's speed.
            None if self.device().context.tick.is_some() => 1,
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
            let submitted = self.submit(steps)?;
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
        let networks = &self.device().context.buffers.networks;
        inference::evaluate(&self.device().context, networks, &self.lane(), points)
    }

    fn fitted(&mut self) -> Result<FittedField, BackendError> {
        Ok(FittedField::Network(FittedNetwork {
            parameters: self.read_state()?.kept,
            conditioning: self.conditioning,
        }))
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
        self.read_state().map(Some)
    }

    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError> {
        check_state(&state, LAID_OUT)?;
        let mut transposed = mlp::zeros();
        transpose_middle_layers(state.parameters.as_slice(), transposed.as_mut_slice());
        let [means, squares] = &state.moments;
        self.network.write(PARAMETERS, &state.parameters);
        self.network.write(TRANSPOSED, &transposed);
        self.network.write(MEANS, means);
        self.network.write(SQUARES, squares);
        self.network.write(KEPT, &state.kept);
        self.status = Status {
            iterations: state.iterations as u32,
            best_iteration: state.best_iteration as u32,
            best_loss: state.best_loss.min(f32::MAX),
            seen: state.seen.best.is_some().into(),
            seen_best: state.seen.best.unwrap_or_default(),
            without_progress: state.seen.without_progress as u32,
            ..Status::default()
        };
        self.device().context.watchdog.check()
    }

    fn shorten(&mut self, max_iterations: usize) {
        self.schedule.shorten(max_iterations);
    }
}

/// On the GPU the largest finite float stands for infinity.
fn widened(loss: f32) -> f32 {
    if loss == f32::MAX {
        f32::INFINITY
    } else {
        loss
    }
}
