//! One fit on the CPU: forward pass, loss and backward pass over tiles on all threads, then Adam.
//! The loop is the same for every model, loss and schedule.
//!
//! Sums are taken in the fixed order of `field/reduction.rs`, so the result has the same bits for
//! any number of threads.

use core::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::inference::evaluate;
use super::model::Model;
use super::tile::{TILE, WorkingSets};
use crate::flow::data::{Control, Interrupt, Point, Progress};
use crate::flow::field::{
    Advance, BackendError, Batch, Chunks, EarlyStop, FitReport, Loss, Parameters, Schedule,
    Trainer, TrainerState, reduction,
};

/// Parameters that one thread sums and updates at a time.
const SLICE: usize = 4096;

/// Chunk gradients held in memory at once. If a batch has more chunks, the held ones are summed
/// into the first.
const HELD: usize = 32;

/// The gradient sum of one chunk, and the time of its losses.
struct Chunk {
    gradients: Parameters,
    query_seconds: f64,
}

/// A chunk to compute: its points, and the output slice of their losses.
struct Due<'a> {
    chunk: &'a mut Chunk,
    /// Index of the first point in the batch.
    first: usize,
    points: &'a [Point],
    losses: &'a mut [f32],
}

/// A model with its optimizer, the loss that it is fitted to, and the schedule of its iterations.
pub(super) struct CpuTrainer<M: Model, L: Loss> {
    threads: Arc<rayon::ThreadPool>,
    model: M,
    loss: L,
    schedule: Schedule,
    /// Parameters, moments, the result so far and the iteration counts.
    state: TrainerState,
    early_stop: Option<EarlyStop>,
    chunks: Vec<Chunk>,
    /// Losses of the current iteration's points.
    losses: Vec<f32>,
    working_sets: WorkingSets<M::WorkingSet>,
    query_seconds: f64,
}

impl<M: Model, L: Loss> CpuTrainer<M, L> {
    /// A fit of `model` to `loss` that starts from `parameters`.
    pub(super) fn new(
        threads: Arc<rayon::ThreadPool>,
        mut model: M,
        loss: L,
        schedule: Schedule,
        parameters: Parameters,
    ) -> Self {
        model.update(&parameters);
        Self {
            working_sets: WorkingSets::new(&threads, || model.working_set()),
            threads,
            model,
            loss,
            early_stop: schedule.options.early_stop.map(EarlyStop::new),
            schedule,
            state: TrainerState::at_start(parameters),
            chunks: Vec::new(),
            losses: Vec::new(),
            query_seconds: 0.0,
        }
    }

    /// One iteration: gradients, update of the result, Adam step. Returns the loss and whether
    /// early stopping fired; none if the loss is not finite.
    ///
    /// # Errors
    /// The interrupt of `control`, which abandons the iteration.
    fn iterate(&mut self, control: &dyn Control) -> Result<Option<(f32, bool)>, Interrupt> {
        let batch = self.schedule.batch(self.state.iterations);
        self.prepare(&batch, control)?;
        let held = self.accumulate(batch, control);
        let loss = reduction::mean(&self.losses);
        if !loss.is_finite() {
            return Ok(None);
        }
        let stop = self
            .early_stop
            .as_mut()
            .is_some_and(|rule| rule.observe(loss));
        self.keep(loss, stop);
        self.step(held);
        self.state.iterations += 1;
        Ok(Some((loss, stop)))
    }

    /// Prepares the loss for `batch`.
    fn prepare(&mut self, batch: &Range<usize>, control: &dyn Control) -> Result<(), Interrupt> {
        let began = control.seconds();
        let points = &self.schedule.points[batch.clone()];
        let flow = || {
            let parameters = &self.state.parameters;
            let (model, sets) = (&self.model, &self.working_sets);
            evaluate(model, parameters, &self.threads, sets, points)
        };
        let batch = Batch {
            points,
            flow: &flow,
        };
        self.loss.prepare(&batch, control)?;
        self.query_seconds += control.seconds() - began;
        Ok(())
    }

    /// Forward pass, loss and backward pass over `batch`. Returns how many chunks hold its
    /// gradients.
    fn accumulate(&mut self, batch: Range<usize>, control: &dyn Control) -> usize {
        let cut = Chunks::new(self.schedule.largest_batch());
        self.losses.resize(batch.len(), 0.0);
        let mut next = 0;
        let mut held = 0;
        while next < cut.count {
            if held == HELD {
                self.add_to_the_first();
                held = 1;
            }
            let now = (HELD - held).min(cut.count - next);
            self.compute(&batch, &cut, next..next + now, held, control);
            next += now;
            held += now;
        }
        held
    }

    /// Forward pass, loss and backward pass over some chunks of `batch`, held from index `first`
    /// on.
    fn compute(
        &mut self,
        batch: &Range<usize>,
        cut: &Chunks,
        some: Range<usize>,
        first: usize,
        control: &dyn Control,
    ) {
        let threads = self.threads.current_num_threads().min(some.len()) as f64;
        let held = first + some.len();
        let parameters = &self.state.parameters;
        let empty = || Chunk {
            gradients: parameters.zeros_like(),
            query_seconds: 0.0,
        };
        self.chunks.resize_with(held.max(self.chunks.len()), empty);
        let points = &self.schedule.points[batch.clone()];
        let within =
            |range: Range<usize>| range.start.min(points.len())..range.end.min(points.len());
        let mut due = Vec::with_capacity(some.len());
        let mut losses = &mut self.losses[within(cut.points(some.start)).start..];
        for (number, chunk) in some.zip(&mut self.chunks[first..held]) {
            let own = within(cut.points(number));
            let (losses_here, rest) = core::mem::take(&mut losses).split_at_mut(own.len());
            losses = rest;
            due.push(Due {
                chunk,
                first: own.start,
                points: &points[own],
                losses: losses_here,
            });
        }
        let weight = 1.0 / points.len() as f32;
        let (model, loss, working_sets) = (&self.model, &self.loss, &self.working_sets);
        let run = |due: Due<'_>| {
            let mut working_set = working_sets.own();
            let mut flow_gradients = [[0.0; 3]; TILE];
            let Chunk {
                gradients,
                query_seconds,
            } = due.chunk;
            gradients.as_mut_slice().fill(0.0);
            *query_seconds = 0.0;
            let mut index = due.first;
            for (points, losses) in due.points.chunks(TILE).zip(due.losses.chunks_mut(TILE)) {
                let flow = model.forward(parameters, points, &mut working_set);
                let began = control.seconds();
                for (row, seen) in losses.iter_mut().enumerate() {
                    let loss = loss.at(index, points[row], flow[row]);
                    *seen = loss.value;
                    flow_gradients[row] = loss.gradient.map(|g| g * weight);
                    index += 1;
                }
                *query_seconds += control.seconds() - began;
                let flow_gradients = &flow_gradients[..points.len()];
                model.backward(parameters, flow_gradients, &mut working_set, gradients);
            }
        };
        self.threads.install(|| due.into_par_iter().for_each(run));
        let chunks = &self.chunks[first..held];
        let query: f64 = chunks.iter().map(|chunk| chunk.query_seconds).sum();
        self.query_seconds += query / threads;
    }

    /// Adds the gradients of all other held chunks to those of the first, in order.
    fn add_to_the_first(&mut self) {
        let [first, others @ ..] = self.chunks.as_mut_slice() else {
            return;
        };
        let slices = first.gradients.as_mut_slice().par_chunks_mut(SLICE);
        self.threads.install(|| {
            slices.enumerate().for_each(|(slice, sums)| {
                add_slices(sums, others, slice);
            });
        });
    }

    /// Updates the result with the current parameters. As in the published code, the iteration at
    /// which early stopping fires is not a candidate for the best one.
    fn keep(&mut self, loss: f32, stop: bool) {
        let state = &mut self.state;
        let ema_weight = self.schedule.ema_weight(state.iterations);
        let iteration = state.iterations + 1;
        match ema_weight {
            None if loss <= state.best_loss && !stop => {
                state.best_loss = loss;
                state.best_iteration = iteration;
                let parameters = state.parameters.as_slice();
                state.kept.as_mut_slice().copy_from_slice(parameters);
            }
            None => {}
            Some(ema_weight) => {
                let kept = state.kept.as_mut_slice().iter_mut();
                for (kept, parameter) in kept.zip(state.parameters.as_slice()) {
                    *kept = if ema_weight < 1.0 {
                        *kept + ema_weight * (parameter - *kept)
                    } else {
                        *parameter
                    };
                }
                let before = if iteration == 1 {
                    loss
                } else {
                    state.best_loss
                };
                state.best_loss = before + ema_weight * (loss - before);
                state.best_iteration = iteration;
            }
        }
    }

    /// Sums the chunks' gradients in order and takes one Adam step.
    fn step(&mut self, held: usize) {
        let adam = self.schedule.adam(self.state.iterations);
        let chunks = &self.chunks[..held];
        let [means, squares] = &mut self.state.moments;
        let parameters = self.state.parameters.as_mut_slice().par_chunks_mut(SLICE);
        let means = means.as_mut_slice().par_chunks_mut(SLICE);
        let squares = squares.as_mut_slice().par_chunks_mut(SLICE);
        let slices = parameters.zip(means).zip(squares).enumerate();
        self.threads.install(|| {
            slices.for_each(|(slice, ((parameters, means), squares))| {
                let mut sums = [0.0f32; SLICE];
                let sums = &mut sums[..parameters.len()];
                add_slices(sums, chunks, slice);
                adam.apply(sums, parameters, [means, squares]);
            });
        });
        self.model.update(&self.state.parameters);
    }
}

/// Adds one slice of each chunk's gradients to `sums`, in order.
fn add_slices(sums: &mut [f32], chunks: &[Chunk], slice: usize) {
    for chunk in chunks {
        let gradients = &chunk.gradients.as_slice()[slice * SLICE..];
        for (sum, gradient) in sums.iter_mut().zip(gradients) {
            *sum += gradient;
        }
    }
}

impl<M: Model, L: Loss> Trainer for CpuTrainer<M, L> {
    fn advance(&mut self, steps: usize, control: &dyn Control) -> Result<Advance, BackendError> {
        for step in 0..steps {
            if self.state.iterations >= self.schedule.options.max_iterations {
                return Ok(Advance::Exhausted);
            }
            if let Some(interrupt) = control.interrupt() {
                return Ok(Advance::Interrupted(interrupt));
            }
            if step > 0 && control.snapshot_due() {
                return Ok(Advance::Continues);
            }
            let (loss, stop) = match self.iterate(control) {
                Ok(Some(done)) => done,
                Ok(None) => return Ok(Advance::Diverged),
                Err(interrupt) => return Ok(Advance::Interrupted(interrupt)),
            };
            control.progress(Progress {
                done: self.state.iterations,
                total: self.schedule.options.max_iterations,
                loss: loss.into(),
            });
            if stop {
                return Ok(Advance::Converged);
            }
        }
        Ok(Advance::Continues)
    }

    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        Ok(evaluate(
            &self.model,
            &self.state.kept,
            &self.threads,
            &self.working_sets,
            points,
        ))
    }

    fn report(&self) -> FitReport {
        FitReport {
            iterations: self.state.iterations,
            best_iteration: self.state.best_iteration,
            best_loss: self.state.best_loss.into(),
            query_seconds: self.query_seconds,
        }
    }

    fn state(&mut self) -> Result<TrainerState, BackendError> {
        let rule = self.early_stop.as_ref();
        Ok(TrainerState {
            seen: rule.map(EarlyStop::seen).unwrap_or_default(),
            ..self.state.clone()
        })
    }

    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError> {
        let rule = self.schedule.options.early_stop;
        self.early_stop = rule.map(|options| EarlyStop::resumed(options, state.seen));
        self.model.update(&state.parameters);
        self.state = state;
        Ok(())
    }

    fn shorten(&mut self, max_iterations: usize) {
        self.schedule.shorten(max_iterations);
    }
}

#[cfg(test)]
mod interface_tests;
#[cfg(test)]
mod tests;
