//! One optimization on the CPU: forward, query, backward over tiles on all threads, then Adam.
//!
//! Points are cut into chunks by their number alone; each chunk sums its own gradients and chunks
//! are added in order, so the bits do not depend on the threads.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::kernels::{Kernels, TILE, Tile};
use crate::flow::backend::{Advance, BackendError, Report, Trainer};
use crate::flow::distance::DistanceTransform;
use crate::flow::early_stop::EarlyStop;
use crate::flow::field::mlp::{MIDDLE_LAYERS, Parameters, middle_layer, transpose_middle_layer};
use crate::flow::optimizer::AdamStep;
use crate::flow::options::{Decay, Inputs, Options, Start};
use crate::flow::points::Point;
use crate::flow::random::Random;
use crate::flow::watch::{Progress, Watch};

/// Floats that one thread reduces and steps at a time.
const SLICE: usize = 4096;

/// Points' coordinates to network inputs.
#[derive(Clone, Copy)]
struct Conditioning {
    center: Point,
    scale: f32,
}

impl Conditioning {
    fn new(points: &[Point], inputs: Inputs) -> Self {
        match inputs {
            Inputs::Raw => Self { center: [0.0; 3], scale: 1.0 },
            Inputs::Centered { scale_m } => {
                let mut sum = [0.0f64; 3];
                for point in points {
                    for axis in 0..3 {
                        sum[axis] += f64::from(point[axis]);
                    }
                }
                let count = points.len().max(1) as f64;
                Self { center: sum.map(|s| (s / count) as f32), scale: 1.0 / scale_m }
            }
        }
    }

    fn apply(&self, point: Point) -> Point {
        core::array::from_fn(|a| (point[a] - self.center[a]) * self.scale)
    }
}

/// What one chunk adds up over its tiles.
struct Chunk {
    gradients: Parameters,
    loss: f64,
    query_seconds: f64,
}

pub(super) struct CpuTrainer {
    kernels: Kernels,
    threads: Arc<rayon::ThreadPool>,
    distance: DistanceTransform,
    options: Options,
    conditioning: Conditioning,
    /// Source points in the order in which batches take them.
    points: Vec<Point>,
    parameters: Parameters,
    transposed: Parameters,
    mean: Parameters,
    square: Parameters,
    best: Parameters,
    early_stop: Option<EarlyStop>,
    chunks: Vec<Chunk>,
    tiles: Vec<Mutex<Tile>>,
    report: Report,
}

impl CpuTrainer {
    pub(super) fn new(
        kernels: Kernels,
        threads: Arc<rayon::ThreadPool>,
        distance: DistanceTransform,
        source: &[Point],
        options: &Options,
    ) -> Self {
        let mut random = Random::new(options.seed);
        let mut parameters = Parameters::xavier(&mut random);
        if options.start == Start::ZeroFlow {
            parameters.scale_last_layer(0.0);
        }
        let mut points = source.to_vec();
        if options.batch.is_some() {
            random.shuffle(&mut points);
        }
        let tiles = (0..threads.current_num_threads()).map(|_| Mutex::new(Tile::new())).collect();
        let mut trainer = Self {
            kernels,
            threads,
            conditioning: Conditioning::new(source, options.inputs),
            points,
            transposed: Parameters::zeros(),
            mean: Parameters::zeros(),
            square: Parameters::zeros(),
            best: parameters.clone(),
            parameters,
            early_stop: options.early_stop.map(EarlyStop::new),
            chunks: Vec::new(),
            tiles,
            report: Report {
                best_loss: f64::INFINITY,
                distance_bytes: distance.bytes(),
                ..Report::default()
            },
            distance,
            options: options.clone(),
        };
        trainer.transpose();
        trainer
    }

    /// The points of this iteration.
    fn batch(&self) -> core::ops::Range<usize> {
        let all = self.points.len();
        match self.options.batch {
            Some(size) if size < all => {
                let batches = all.div_ceil(size);
                let index = self.report.iterations % batches;
                index * all / batches..(index + 1) * all / batches
            }
            _ => 0..all,
        }
    }

    /// Forward, query, backward over `batch`; returns the mean distance.
    fn accumulate(&mut self, batch: core::ops::Range<usize>, watch: &dyn Watch) -> f64 {
        let points = &self.points[batch];
        let tiles = points.len().div_ceil(TILE);
        let count = chunk_count(tiles);
        self.chunks.resize_with(count.max(self.chunks.len()), || Chunk {
            gradients: Parameters::zeros(),
            loss: 0.0,
            query_seconds: 0.0,
        });
        let weight = 1.0 / points.len() as f32; let norm = self.options.norm * weight; let dead = self.options.dead;
        let truncation = self.options.truncation_m.unwrap_or(f32::INFINITY);
        let (kernels, distance, conditioning) = (self.kernels, &self.distance, self.conditioning);
        let (parameters, transposed) = (&self.parameters, &self.transposed);
        let working_sets = &self.tiles;
        let chunks = &mut self.chunks[..count];
        self.threads.install(|| {
            chunks.par_iter_mut().enumerate().for_each(|(index, chunk)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                let mut tile =
                    working_sets[thread].lock().unwrap_or_else(PoisonError::into_inner);
                chunk.gradients.as_mut_slice().fill(0.0);
                chunk.loss = 0.0;
                chunk.query_seconds = 0.0;
                for number in index * tiles / count..(index + 1) * tiles / count {
                    let start = number * TILE;
                    let points = &points[start..(start + TILE).min(points.len())];
                    let mut inputs = [[0.0; 3]; TILE];
                    for (input, &point) in inputs.iter_mut().zip(points) {
                        *input = conditioning.apply(point);
                    }
                    tile.load(&inputs[..points.len()]);
                    kernels.forward(parameters, &mut tile);
                    let began = watch.seconds();
                    for (row, point) in points.iter().enumerate() {
                        let flow = tile.outputs[row];
                        let sample =
                            distance.sample(core::array::from_fn(|a| point[a] + flow[a]));
                        chunk.loss += f64::from(sample.distance.min(truncation));
                        let weight = if sample.distance < truncation && sample.distance > dead { weight } else { 0.0 };
                        let length = (flow[0]*flow[0]+flow[1]*flow[1]+flow[2]*flow[2]).sqrt();
                        let pull = norm / length.max(1e-3);
                        tile.output_gradients[row] = core::array::from_fn(|a| sample.gradient[a] * weight + flow[a]*pull);
                    }
                    chunk.query_seconds += watch.seconds() - began;
                    kernels.backward(parameters, transposed, &mut tile, &mut chunk.gradients);
                }
            });
        });
        let threads = self.threads.current_num_threads().min(count) as f64;
        let query: f64 = chunks.iter().map(|c| c.query_seconds).sum();
        self.report.query_seconds += query / threads;
        chunks.iter().map(|c| c.loss).sum::<f64>() * f64::from(weight)
    }

    /// Adds the chunks' gradients in order and steps the parameters.
    fn step(&mut self, chunks: usize) {
        let done = self.report.iterations as f64 / self.options.max_iterations as f64;
        let rate = f64::from(self.options.learning_rate)
            * match self.options.decay {
                Decay::Constant => 1.0,
                Decay::Linear => 1.0 - done,
                Decay::Cosine => 0.5 + 0.5 * (std::f64::consts::PI * done).cos(),
            };
        let adam = AdamStep::new(self.report.iterations + 1, rate, f64::from(self.options.beta2));
        let chunks = &self.chunks[..chunks];
        let parameters = self.parameters.as_mut_slice().par_chunks_mut(SLICE);
        let means = self.mean.as_mut_slice().par_chunks_mut(SLICE);
        let squares = self.square.as_mut_slice().par_chunks_mut(SLICE);
        self.threads.install(|| {
            parameters.zip(means).zip(squares).enumerate().for_each(
                |(slice, ((parameters, means), squares))| {
                    let mut sum = [0.0f32; SLICE];
                    let sum = &mut sum[..parameters.len()];
                    for chunk in chunks {
                        let gradients = &chunk.gradients.as_slice()[slice * SLICE..];
                        for (sum, gradient) in sum.iter_mut().zip(gradients) {
                            *sum += gradient;
                        }
                    }
                    for (((gradient, parameter), mean), square) in
                        sum.iter().zip(parameters).zip(means).zip(squares)
                    {
                        adam.apply(*gradient, parameter, [mean, square]);
                    }
                },
            );
        });
        self.transpose();
    }

    fn transpose(&mut self) {
        for layer in 0..MIDDLE_LAYERS {
            let at = middle_layer(layer);
            transpose_middle_layer(
                &self.parameters.as_slice()[at.weights..at.bias],
                &mut self.transposed.as_mut_slice()[at.weights..at.bias],
            );
        }
    }
}

/// Chunks that `tiles` tiles are cut into: enough for many cores, few enough that adding their
/// gradients stays small.
fn chunk_count(tiles: usize) -> usize {
    if tiles < 32 { (tiles / 4).max(1) } else { (tiles / 11).clamp(8, 32) }
}

impl Trainer for CpuTrainer {
    fn advance(&mut self, steps: usize, watch: &dyn Watch) -> Result<Advance, BackendError> {
        for _ in 0..steps {
            if self.report.iterations >= self.options.max_iterations {
                return Ok(Advance::Exhausted);
            }
            if let Some(interrupt) = watch.interrupt() {
                return Ok(Advance::Interrupted(interrupt));
            }
            let began = watch.seconds();
            let query_before = self.report.query_seconds;
            let batch = self.batch();
            let chunks = chunk_count(batch.len().div_ceil(TILE));
            let loss = self.accumulate(batch, watch);
            if !loss.is_finite() {
                return Ok(Advance::Diverged);
            }
            let converged = self.early_stop.as_mut().is_some_and(|rule| rule.observe(loss));
            if let Some(decay) = self.options.average {
                let keep = decay.min(self.report.iterations as f32 / (self.report.iterations + 10) as f32);
                let parameters = self.parameters.as_slice();
                for (b, p) in self.best.as_mut_slice().iter_mut().zip(parameters) { *b += (1.0 - keep) * (p - *b); }
                self.report.best_loss = loss;
            } else if loss <= self.report.best_loss && !converged {
                self.report.best_loss = loss;
                self.report.best_iteration = self.report.iterations + 1;
                self.best.as_mut_slice().copy_from_slice(self.parameters.as_slice());
            }
            self.step(chunks);
            self.report.iterations += 1;
            let query = self.report.query_seconds - query_before;
            self.report.network_seconds += watch.seconds() - began - query;
            watch.progress(Progress {
                iteration: self.report.iterations,
                max_iterations: self.options.max_iterations,
                loss,
            });
            if converged {
                return Ok(Advance::Converged);
            }
        }
        Ok(Advance::Continues)
    }

    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        let mut flow = vec![[0.0; 3]; points.len()];
        let (kernels, conditioning, best) = (self.kernels, self.conditioning, &self.best);
        let working_sets = &self.tiles;
        self.threads.install(|| {
            flow.par_chunks_mut(TILE).zip(points.par_chunks(TILE)).for_each(|(flow, points)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                let mut tile =
                    working_sets[thread].lock().unwrap_or_else(PoisonError::into_inner);
                let mut inputs = [[0.0; 3]; TILE];
                for (input, &point) in inputs.iter_mut().zip(points) {
                    *input = conditioning.apply(point);
                }
                tile.load(&inputs[..points.len()]);
                kernels.forward(best, &mut tile);
                flow.copy_from_slice(&tile.outputs[..points.len()]);
            });
        });
        Ok(flow)
    }

    fn report(&self) -> Report {
        self.report
    }
}
