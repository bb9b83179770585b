//! One fit on the CPU: forward pass, loss and backward pass over tiles on all threads, then Adam.
//! The loop is the same for every model, loss and schedule.
//!
//! Sums are taken in the fixed order of `field/reduction.rs`, so the result has the same bits for
//! any number of threads.

use core::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::model::{Model, forward};
use super::tile::{TILE, WorkingSets};
use crate::flow::data::{Control, Interrupt, Point, Progress};
use crate::flow::field::{
    Advance, BackendError, Batch, Chunks, EarlyStop, FitReport, FittedField, Loss, Output,
    Parameters, Schedule, Trainer, TrainerState, check_state, reduction,
};

/// Parameters that one thread updates at a time.
const SLICE: usize = 4096;

/// A chunk to compute: its points, its gradients, and the output slice of their losses.
struct Due<'a, G> {
    gradients: &'a mut G,
    /// Time of its losses, seconds.
    query_seconds: &'a mut f64,
    /// Index of the first point in the batch.
    first: usize,
    points: &'a [Point],
    losses: &'a mut [f32],
}

/// A model with its optimizer, the loss that it is fitted to, and the schedule of its iterations.
pub(super) struct CpuTrainer<M: Model, L: Loss<M::Output>> {
    threads: Arc<rayon::ThreadPool>,
    model: M,
    loss: L,
    schedule: Schedule,
    /// Parameters, moments, the result so far and the iteration counts.
    state: TrainerState,
    early_stop: Option<EarlyStop>,
    chunks: Vec<M::ChunkGradients>,
    /// Times of the chunks' losses, seconds.
    query_times: Vec<f64>,
    /// Derivatives of the loss with respect to the parameters.
    gradients: Parameters,
    /// The batch that the model has placed.
    placed: Option<Range<usize>>,
    /// Losses of the current iteration's points.
    losses: Vec<f32>,
    working_sets: WorkingSets<M::WorkingSet>,
    query_seconds: f64,
}

impl<M: Model, L: Loss<M::Output>> CpuTrainer<M, L> {
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
            gradients: parameters.zeros_like(),
            state: TrainerState::at_start(parameters),
            chunks: Vec::new(),
            query_times: Vec::new(),
            placed: None,
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
        let batch = self
            .schedule
            .batch(self.state.iterations, self.state.growth);
        if self.placed.as_ref() != Some(&batch) {
            self.model.place(&self.schedule.points[batch.clone()]);
            self.placed = Some(batch.clone());
        }
        self.prepare(&batch, control)?;
        let held = self.accumulate(batch, control);
        let loss = reduction::mean(&self.losses) + self.model.regularization();
        if !loss.is_finite() {
            return Ok(None);
        }
        let stalled = self
            .early_stop
            .as_mut()
            .is_some_and(|rule| rule.observe(loss));
        let stop = stalled && !self.schedule.is_growing(self.state.growth);
        self.keep(loss, stop);
        self.step(held);
        self.state.iterations += 1;
        self.grow(loss, stalled);
        Ok(Some((loss, stop)))
    }

    /// Grows the batch where that is due. Losses of other batches are no measure, so the stopping
    /// rule and the best iteration then begin anew.
    fn grow(&mut self, loss: f32, stalled: bool) {
        let state = &mut self.state;
        let (growth, done) = (state.growth, state.iterations);
        state.growth = self.schedule.grown(growth, done, loss, stalled);
        if state.growth.doublings > growth.doublings {
            state.best_loss = f32::INFINITY;
            let rule = self.schedule.options.early_stop;
            self.early_stop = rule.map(EarlyStop::new);
        }
    }

    /// Prepares the loss for `batch`.
    fn prepare(&mut self, batch: &Range<usize>, control: &dyn Control) -> Result<(), Interrupt> {
        let began = control.seconds();
        let points = &self.schedule.points[batch.clone()];
        let outputs = || {
            let parameters = &self.state.parameters;
            let (model, sets) = (&self.model, &self.working_sets);
            forward(model, parameters, &self.threads, sets, points)
        };
        let batch = Batch {
            points,
            range: batch,
            done: self.state.iterations,
            outputs: &outputs,
        };
        self.loss.prepare(&batch, control)?;
        self.query_seconds += control.seconds() - began;
        Ok(())
    }

    /// Forward pass, loss and backward pass over `batch`. Returns how many chunks hold its
    /// gradients.
    fn accumulate(&mut self, batch: Range<usize>, control: &dyn Control) -> usize {
        let cut = Chunks::new(self.schedule.largest_batch(self.state.growth));
        self.losses.resize(batch.len(), 0.0);
        let mut next = 0;
        let mut held = 0;
        while next < cut.count {
            if held == M::HELD {
                self.model.add_to_the_first(&mut self.chunks[..held]);
                held = 1;
            }
            let now = (M::HELD - held).min(cut.count - next);
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
        let most = held.max(self.chunks.len());
        self.chunks
            .resize_with(most, || self.model.chunk_gradients());
        self.query_times.resize(most, 0.0);
        let points = &self.schedule.points[batch.clone()];
        let within =
            |range: Range<usize>| range.start.min(points.len())..range.end.min(points.len());
        let mut due = Vec::with_capacity(some.len());
        let mut losses = &mut self.losses[within(cut.points(some.start)).start..];
        let chunks = self.chunks[first..held].iter_mut();
        let chunks = chunks.zip(&mut self.query_times[first..held]);
        for (number, (gradients, query_seconds)) in some.zip(chunks) {
            let own = within(cut.points(number));
            let (losses_here, rest) = core::mem::take(&mut losses).split_at_mut(own.len());
            losses = rest;
            due.push(Due {
                gradients,
                query_seconds,
                first: own.start,
                points: &points[own],
                losses: losses_here,
            });
        }
        let weight = 1.0 / points.len() as f32;
        let (model, loss, working_sets) = (&self.model, &self.loss, &self.working_sets);
        let run = |due: Due<'_, M::ChunkGradients>| {
            let mut working_set = working_sets.own();
            let mut output_gradients = [M::Output::default(); TILE];
            let Due {
                gradients,
                query_seconds,
                ..
            } = due;
            model.clear(gradients);
            *query_seconds = 0.0;
            let mut index = due.first;
            for (points, losses) in due.points.chunks(TILE).zip(due.losses.chunks_mut(TILE)) {
                let outputs = model.forward(parameters, points, index, &mut working_set);
                let began = control.seconds();
                for (row, seen) in losses.iter_mut().enumerate() {
                    let loss = loss.at(index, points[row], outputs[row]);
                    *seen = loss.value;
                    output_gradients[row] = loss.gradient.scaled(weight);
                    index += 1;
                }
                *query_seconds += control.seconds() - began;
                let output_gradients = &output_gradients[..points.len()];
                model.backward(parameters, output_gradients, &mut working_set, gradients);
            }
        };
        self.threads.install(|| due.into_par_iter().for_each(run));
        let query: f64 = self.query_times[first..held].iter().sum();
        self.query_seconds += query / threads;
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

    /// Takes one Adam step from the gradients of the held chunks.
    fn step(&mut self, held: usize) {
        self.model
            .gradient(&self.chunks[..held], &mut self.gradients);
        let adam = self.schedule.adam(self.state.iterations);
        let [means, squares] = &mut self.state.moments;
        let parameters = self.state.parameters.as_mut_slice().par_chunks_mut(SLICE);
        let means = means.as_mut_slice().par_chunks_mut(SLICE);
        let squares = squares.as_mut_slice().par_chunks_mut(SLICE);
        let gradients = self.gradients.as_slice().par_chunks(SLICE);
        let slices = parameters.zip(means).zip(squares).zip(gradients);
        self.threads.install(|| {
            slices.for_each(|(((parameters, means), squares), gradients)| {
                adam.apply(gradients, parameters, [means, squares]);
            });
        });
        self.model.update(&self.state.parameters);
    }
}

impl<M: Model, L: Loss<M::Output>> Trainer for CpuTrainer<M, L> {
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
        let parameters = &self.state.kept;
        Ok(self.model.evaluate(parameters, points, &self.working_sets))
    }

    fn fitted(&mut self) -> Result<FittedField, BackendError> {
        Ok(self.model.fitted(&self.state.kept))
    }

    fn report(&self) -> FitReport {
        FitReport {
            iterations: self.state.iterations,
            best_iteration: self.state.best_iteration,
            best_loss: self.state.best_loss.into(),
            query_seconds: self.query_seconds,
        }
    }

    fn state(&mut self) -> Result<Option<TrainerState>, BackendError> {
        if self.loss.depends_on_earlier(self.state.iterations) {
            return Ok(None);
        }
        let rule = self.early_stop.as_ref();
        Ok(Some(TrainerState {
            seen: rule.map(EarlyStop::seen).unwrap_or_default(),
            ..self.state.clone()
        }))
    }

    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError> {
        check_state(&state, self.state.parameters.as_slice().len())?;
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
mod tests;
