//! One optimization on the card. Knows what a pair wants; how pairs share the card is batch.rs's.

use std::sync::Arc;

use super::backend::Card;
use super::batcher::{Done, Request};
use super::distance::GpuTransform;
use super::layout::{ARRAYS, CONVERGED, DIVERGED, STEPS, Status};
use super::memory::NETWORK_BYTES;
use super::tiling::Cut;
use super::{inference, layout};
use crate::flow::data::{Control, Point, Progress};
use crate::flow::field::{
    Advance, BackendError, FitReport, LAID_OUT, Parameters, Schedule, Seen, Trainer, TrainerState,
    transpose_middle_layers,
};
use crate::flow::options::{Options, Precision};

/// Seconds that a submission should take: a look at the watch, and at the card's health.
const SUBMISSION_SECONDS: f64 = 0.03;
/// Iterations of a submission where the card shows no clock.
const BLIND_STEPS: usize = 4;
/// Iterations of a submission at most, where a stopping rule may end the run in any of them.
const STOPPABLE_STEPS: usize = 16;
/// The places of a lane's arrays; common.wgsl has the same.
const PARAMETERS: u64 = 0;
const TRANSPOSED: u64 = 1;
const MEANS: u64 = 2;
const SQUARES: u64 = 3;
pub(super) const KEPT: u64 = 4;

/// One of the card's networks, as long as somebody fits it.
struct Network {
    card: Arc<Card>,
    number: u32,
}

impl Network {
    fn take(card: &Arc<Card>) -> Result<Self, BackendError> {
        let number = card.take_network()?;
        card.batch.joined();
        Ok(Self {
            card: Arc::clone(card),
            number,
        })
    }

    /// Where one of its arrays begins, bytes.
    fn at(&self, array: u64) -> u64 {
        (u64::from(self.number) * ARRAYS as u64 + array) * NETWORK_BYTES
    }

    fn write(&self, array: u64, parameters: &Parameters) {
        let bytes = bytemuck::cast_slice(&parameters.as_slice()[..LAID_OUT]);
        let queue = &self.card.queue;
        queue.write_buffer(&self.card.buffers.networks, self.at(array), bytes);
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        self.card.batch.left();
        self.card.give_network_back(self.number);
    }
}

/// The network, its optimizer and the distance that it is fitted to.
pub(super) struct GpuTrainer<'a> {
    transform: &'a GpuTransform,
    course: Schedule,
    network: Network,
    /// Their place in the store, words.
    points: u32,
    status: Status,
    query_seconds: f64,
}

impl<'a> GpuTrainer<'a> {
    pub(super) fn new(
        transform: &'a GpuTransform,
        source: &[Point],
        options: &Options,
    ) -> Result<Self, BackendError> {
        let card = &transform.card;
        if options.precision == Precision::F16 {
            card.units()?;
        }
        let (course, parameters) = Schedule::new(source, options);
        let chunks = Cut::new(course.largest_batch()).chunks.count as u64;
        if chunks > card.budget.chunks {
            return Err(BackendError::Memory {
                what: "gradients",
                needed: chunks * NETWORK_BYTES,
                available: card.budget.chunk_bytes(),
            });
        }
        let points = transform.room_for(course.points.len())?;
        let at = u64::from(points) * 4;
        let bytes = bytemuck::cast_slice(&course.points);
        card.queue.write_buffer(&card.buffers.store, at, bytes);
        let mut trainer = Self {
            transform,
            network: Network::take(card)?,
            course,
            points,
            status: Status::default(),
            query_seconds: 0.0,
        };
        trainer.restore(TrainerState::at_start(parameters))?;
        Ok(trainer)
    }

    fn card(&self) -> &Arc<Card> {
        &self.transform.card
    }

    /// The lane's record, but for its place among those of a submission.
    pub(super) fn lane(&self) -> layout::Lane {
        let options = &self.course.options;
        let (loss, rule) = (&options.loss, options.early_stop);
        layout::Lane {
            transform: self.transform.record,
            network: self.network.number,
            points: self.points,
            center: self.course.conditioning.center,
            scale: self.course.conditioning.scale,
            margin: loss.margin_m,
            margin_slope: loss.margin_slope,
            truncation: loss.truncation_m.unwrap_or(f32::MAX),
            flow_penalty: loss.flow_penalty,
            average: self.course.fresh(0).is_some().into(),
            patience: rule.map_or(0, |rule| rule.patience.max(1) as u32),
            min_delta: rule.map_or(0.0, |rule| rule.min_delta_m as f32),
            ..layout::Lane::default()
        }
    }

    /// The iteration after `done` others.
    fn step(&self, done: usize) -> layout::Step {
        let batch = self.course.batch(done);
        let adam = self.course.adam(done);
        layout::Step {
            first: batch.start as u32,
            count: batch.len() as u32,
            weight: 1.0 / batch.len() as f32,
            step_size: adam.step_size,
            square_correction: adam.square_correction,
            fresh: self.course.fresh(done).unwrap_or(1.0),
        }
    }

    /// Does up to `steps` iterations in one submission.
    fn submit(&mut self, steps: usize) -> Result<Done, BackendError> {
        let done = self.status.iterations as usize;
        let request = Request {
            lane: self.lane(),
            status: self.status,
            steps: (done..done + steps).map(|done| self.step(done)).collect(),
            cut: Cut::new(self.course.largest_batch()),
            precision: self.course.options.precision,
        };
        let done = self.card().batch.run(self.card(), request)?;
        self.status = done.status;
        if let Some(pace) = done.pace {
            let tiles = Cut::new(self.course.largest_batch()).tiles * done.losses.len();
            self.query_seconds += pace.tile_query * tiles as f64;
        }
        Ok(done)
    }

    /// Iterations that a submission should have.
    fn stride(&self) -> usize {
        let seconds = self.card().batch.pace().map(|pace| {
            let own = pace.tile * Cut::new(self.course.largest_batch()).tiles as f64;
            own.max(pace.iteration)
        });
        // What follows a stop is dispatched in vain.
        let most = match self.course.options.early_stop {
            Some(_) => STOPPABLE_STEPS,
            None => STEPS,
        };
        match seconds {
            Some(seconds) => ((SUBMISSION_SECONDS / seconds.max(1e-6)) as usize).clamp(1, most),
            // The first submission shows how fast the card is.
            None if self.card().tick.is_some() => 1,
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
        let most = self.course.options.max_iterations;
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
                    iteration,
                    max_iterations: most,
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
        let networks = &self.card().buffers.networks;
        inference::evaluate(self.card(), networks, &self.lane(), points)
    }

    fn report(&self) -> FitReport {
        FitReport {
            iterations: self.iterations(),
            best_iteration: self.status.best_iteration as usize,
            best_loss: widened(self.status.best_loss).into(),
            query_seconds: self.query_seconds,
        }
    }

    fn state(&mut self) -> Result<TrainerState, BackendError> {
        let card = self.card();
        let bytes = ARRAYS as u64 * NETWORK_BYTES;
        let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        let copy = card.empty(bytes, usage)?;
        let mut encoder = card.encoder();
        let from = self.network.at(PARAMETERS);
        encoder.copy_buffer_to_buffer(&card.buffers.networks, from, &copy, 0, bytes);
        let read = card.finish(encoder, &copy, bytes)?;
        let array = |array: u64| {
            let mut parameters = Parameters::zeros();
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
            seen: Seen {
                best: (status.seen == 1).then_some(status.seen_best),
                without_progress: status.without_progress as usize,
            },
            iterations: status.iterations as usize,
            best_iteration: status.best_iteration as usize,
            best_loss: widened(status.best_loss),
        })
    }

    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError> {
        let mut transposed = Parameters::zeros();
        transpose_middle_layers(&state.parameters, &mut transposed);
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
        self.card().watchdog.check()
    }

    fn shorten(&mut self, max_iterations: usize) {
        self.course.shorten(max_iterations);
    }
}

/// The card's largest number stands for infinity.
fn widened(loss: f32) -> f32 {
    if loss == f32::MAX {
        f32::INFINITY
    } else {
        loss
    }
}
