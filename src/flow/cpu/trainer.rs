//! One optimization on the CPU: forward, query, backward over tiles on all threads, then Adam.
//! Knows neither deadlines nor files: a watch says when to come back.
//!
//! An iteration's points are cut into chunks by their number alone; each chunk sums its own
//! gradients and chunks are added in order, so the bits do not depend on the threads.

use core::ops::Range;

use rayon::prelude::*;

use super::CpuTransform;
use super::evaluate::evaluate;
use super::tile::{TILE, WorkingSets};
use crate::flow::backend::{Advance, BackendError, Report, Trainer};
use crate::flow::course::Course;
use crate::flow::early_stop::EarlyStop;
use crate::flow::field::mlp::{Parameters, transpose_middle_layers};
use crate::flow::options::Options;
use crate::flow::points::Point;
use crate::flow::snapshot::TrainerState;
use crate::flow::watch::{Progress, Watch};

/// Floats that one thread reduces and steps at a time.
const SLICE: usize = 4096;

/// What one chunk adds up over its tiles.
struct Chunk {
    gradients: Parameters,
    loss: f64,
    query_seconds: f64,
}

/// The network, its optimizer and the distance that it is fitted to.
pub(super) struct CpuTrainer<'a> {
    device: &'a CpuTransform,
    course: Course,
    /// Parameters, moments, the result so far, and what has been reached.
    state: TrainerState,
    transposed: Parameters,
    early_stop: Option<EarlyStop>,
    chunks: Vec<Chunk>,
    working_sets: WorkingSets,
    query_seconds: f64,
}

impl<'a> CpuTrainer<'a> {
    pub(super) fn new(device: &'a CpuTransform, source: &[Point], options: &Options) -> Self {
        let (course, parameters) = Course::new(source, options);
        let mut transposed = Parameters::zeros();
        transpose_middle_layers(&parameters, &mut transposed);
        Self {
            device,
            course,
            state: TrainerState::at_start(parameters),
            transposed,
            early_stop: options.early_stop.map(EarlyStop::new),
            chunks: Vec::new(),
            working_sets: WorkingSets::new(&device.threads),
            query_seconds: 0.0,
        }
    }

    /// One iteration: gradients, keep, step. Returns the loss and whether the stopping rule fired;
    /// nothing where the loss is not finite.
    fn iterate(&mut self, watch: &dyn Watch) -> Option<(f64, bool)> {
        let batch = self.course.batch(self.state.iterations);
        let tiles = batch.len().div_ceil(TILE);
        let chunks = chunk_count(tiles);
        self.chunks
            .resize_with(chunks.max(self.chunks.len()), || Chunk {
                gradients: Parameters::zeros(),
                loss: 0.0,
                query_seconds: 0.0,
            });
        self.accumulate(batch.clone(), chunks, watch);
        let done = &self.chunks[..chunks];
        let loss = done.iter().map(|c| c.loss).sum::<f64>() / batch.len() as f64;
        let threads = self.device.threads.current_num_threads().min(chunks) as f64;
        self.query_seconds += done.iter().map(|c| c.query_seconds).sum::<f64>() / threads;
        if !loss.is_finite() {
            return None;
        }
        let stop = self
            .early_stop
            .as_mut()
            .is_some_and(|rule| rule.observe(loss));
        self.keep(loss, stop);
        self.step(chunks);
        self.state.iterations += 1;
        Some((loss, stop))
    }

    /// Forward, query, backward over `batch`, into the first `count` chunks.
    fn accumulate(&mut self, batch: Range<usize>, count: usize, watch: &dyn Watch) {
        let points = &self.course.points[batch];
        let tiles = points.len().div_ceil(TILE);
        let weight = 1.0 / points.len() as f32;
        let (device, loss) = (self.device, &self.course.options.loss);
        let (parameters, transposed) = (&self.state.parameters, &self.transposed);
        let (conditioning, working_sets) = (&self.course.conditioning, &self.working_sets);
        let chunks = &mut self.chunks[..count];
        let run = |(index, chunk): (usize, &mut Chunk)| {
            let mut tile = working_sets.own();
            chunk.gradients.as_mut_slice().fill(0.0);
            chunk.loss = 0.0;
            chunk.query_seconds = 0.0;
            let first = index * tiles / count * TILE;
            let last = ((index + 1) * tiles / count * TILE).min(points.len());
            for points in points[first..last].chunks(TILE) {
                tile.load(points.iter().map(|&point| conditioning.apply(point)));
                device.kernels.forward(parameters, &mut tile);
                let began = watch.seconds();
                for (row, point) in points.iter().enumerate() {
                    let flow = tile.outputs[row];
                    let deformed = core::array::from_fn(|a| point[a] + flow[a]);
                    let loss = loss.at(*point, device.distance.sample(deformed), flow);
                    chunk.loss += f64::from(loss.value);
                    tile.output_gradients[row] = loss.gradient.map(|g| g * weight);
                }
                chunk.query_seconds += watch.seconds() - began;
                device
                    .kernels
                    .backward(parameters, transposed, &mut tile, &mut chunk.gradients);
            }
        };
        device
            .threads
            .install(|| chunks.par_iter_mut().enumerate().for_each(run));
    }

    /// Takes the current parameters into the result. As in the published code, the iteration at
    /// which the stopping rule fires is not a candidate.
    fn keep(&mut self, loss: f64, stop: bool) {
        let state = &mut self.state;
        let fresh = self.course.fresh(state.iterations);
        let iteration = state.iterations + 1;
        match fresh {
            None if loss <= state.best_loss && !stop => {
                state.best_loss = loss;
                state.best_iteration = iteration;
                let parameters = state.parameters.as_slice();
                state.kept.as_mut_slice().copy_from_slice(parameters);
            }
            None => {}
            Some(fresh) => {
                let kept = state.kept.as_mut_slice().iter_mut();
                for (kept, parameter) in kept.zip(state.parameters.as_slice()) {
                    *kept += fresh * (parameter - *kept);
                }
                let before = if iteration == 1 {
                    loss
                } else {
                    state.best_loss
                };
                state.best_loss = before + f64::from(fresh) * (loss - before);
                state.best_iteration = iteration;
            }
        }
    }

    /// Adds the chunks' gradients in order and steps the parameters.
    fn step(&mut self, chunks: usize) {
        let adam = self.course.adam(self.state.iterations);
        let chunks = &self.chunks[..chunks];
        let [means, squares] = &mut self.state.moments;
        let parameters = self.state.parameters.as_mut_slice().par_chunks_mut(SLICE);
        let means = means.as_mut_slice().par_chunks_mut(SLICE);
        let squares = squares.as_mut_slice().par_chunks_mut(SLICE);
        let slices = parameters.zip(means).zip(squares).enumerate();
        self.device.threads.install(|| {
            slices.for_each(|(slice, ((parameters, means), squares))| {
                let mut sum = [0.0f32; SLICE];
                let sum = &mut sum[..parameters.len()];
                for chunk in chunks {
                    let gradients = &chunk.gradients.as_slice()[slice * SLICE..];
                    for (sum, gradient) in sum.iter_mut().zip(gradients) {
                        *sum += gradient;
                    }
                }
                adam.apply(sum, parameters, [means, squares]);
            });
        });
        transpose_middle_layers(&self.state.parameters, &mut self.transposed);
    }
}

/// Chunks that `tiles` tiles are cut into: enough for many cores, few enough that adding their
/// gradients stays small beside computing them.
fn chunk_count(tiles: usize) -> usize {
    if tiles < 88 {
        (tiles / 4).clamp(1, 8)
    } else {
        (tiles / 11).min(32)
    }
}

impl Trainer for CpuTrainer<'_> {
    fn advance(&mut self, steps: usize, watch: &dyn Watch) -> Result<Advance, BackendError> {
        for step in 0..steps {
            if self.state.iterations >= self.course.options.max_iterations {
                return Ok(Advance::Exhausted);
            }
            if let Some(interrupt) = watch.interrupt() {
                return Ok(Advance::Interrupted(interrupt));
            }
            if step > 0 && watch.snapshot_due() {
                return Ok(Advance::Continues);
            }
            let Some((loss, stop)) = self.iterate(watch) else {
                return Ok(Advance::Diverged);
            };
            watch.progress(Progress {
                iteration: self.state.iterations,
                max_iterations: self.course.options.max_iterations,
                loss,
            });
            if stop {
                return Ok(Advance::Converged);
            }
        }
        Ok(Advance::Continues)
    }

    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        Ok(evaluate(
            &self.device.kernels,
            &self.device.threads,
            &self.working_sets,
            (&self.state.kept, &self.course.conditioning),
            points,
        ))
    }

    fn report(&self) -> Report {
        Report {
            iterations: self.state.iterations,
            best_iteration: self.state.best_iteration,
            best_loss: self.state.best_loss,
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
        let rule = self.course.options.early_stop;
        self.early_stop = rule.map(|options| EarlyStop::resumed(options, state.seen));
        transpose_middle_layers(&state.parameters, &mut self.transposed);
        self.state = state;
        Ok(())
    }

    fn shorten(&mut self, max_iterations: usize) {
        self.course.shorten(max_iterations);
    }
}

#[cfg(test)]
mod tests;
