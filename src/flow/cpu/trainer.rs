//! One optimization on the CPU: forward, query, backward over tiles on all threads, then Adam.
//!
//! An iteration's points are cut into chunks by their number alone; each chunk sums its own
//! gradients and chunks are added in order, so the bits do not depend on the threads.

use core::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use rayon::prelude::*;

use super::CpuTransform;
use super::tile::{TILE, Tile};
use crate::flow::backend::{Advance, BackendError, Report, Trainer};
use crate::flow::early_stop::EarlyStop;
use crate::flow::field::mlp::{Conditioning, Parameters, transpose_middle_layers};
use crate::flow::optimizer::AdamStep;
use crate::flow::options::{Decay, Keep, Options, Start};
use crate::flow::points::Point;
use crate::flow::random::Random;
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
pub(super) struct CpuTrainer {
    device: CpuTransform,
    options: Options,
    conditioning: Conditioning,
    /// Source points in the order in which batches take them.
    points: Vec<Point>,
    parameters: Parameters,
    transposed: Parameters,
    moments: [Parameters; 2],
    /// The result so far.
    kept: Parameters,
    early_stop: Option<EarlyStop>,
    chunks: Vec<Chunk>,
    /// One working set a thread.
    tiles: Vec<Mutex<Tile>>,
    report: Report,
}

impl CpuTrainer {
    pub(super) fn new(device: CpuTransform, source: &[Point], options: &Options) -> Self {
        let mut random = Random::stream(options.seed, 0);
        let mut parameters = Parameters::xavier(&mut random);
        if options.start == Start::ZeroFlow {
            parameters.clear_last_layer();
        }
        let mut points = source.to_vec();
        if options.batch.is_some_and(|batch| batch < points.len()) {
            random.shuffle(&mut points);
        }
        let mut transposed = Parameters::zeros();
        transpose_middle_layers(&parameters, &mut transposed);
        let threads = device.threads.current_num_threads();
        Self {
            device,
            options: options.clone(),
            conditioning: Conditioning::new(source, options.inputs),
            points,
            kept: parameters.clone(),
            parameters,
            transposed,
            moments: [Parameters::zeros(), Parameters::zeros()],
            early_stop: options.early_stop.map(EarlyStop::new),
            chunks: Vec::new(),
            tiles: (0..threads).map(|_| Mutex::new(Tile::new())).collect(),
            report: Report {
                iterations: 0,
                best_iteration: 0,
                best_loss: f64::INFINITY,
                query_seconds: 0.0,
            },
        }
    }

    /// The points of this iteration: one of equal parts, in turn.
    fn batch(&self) -> Range<usize> {
        let all = self.points.len();
        let parts = self
            .options
            .batch
            .map_or(1, |batch| all.div_ceil(batch.max(1)));
        let part = self.report.iterations % parts;
        part * all / parts..(part + 1) * all / parts
    }

    /// One iteration: gradients, keep, step. Returns the loss and whether the stopping rule fired;
    /// nothing where the loss is not finite.
    fn iterate(&mut self, watch: &dyn Watch) -> Option<(f64, bool)> {
        let batch = self.batch();
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
        self.report.query_seconds += done.iter().map(|c| c.query_seconds).sum::<f64>() / threads;
        if !loss.is_finite() {
            return None;
        }
        let stop = self
            .early_stop
            .as_mut()
            .is_some_and(|rule| rule.observe(loss));
        self.keep(loss, stop);
        self.step(chunks);
        self.report.iterations += 1;
        Some((loss, stop))
    }

    /// Forward, query, backward over `batch`, into the first `count` chunks.
    fn accumulate(&mut self, batch: Range<usize>, count: usize, watch: &dyn Watch) {
        let points = &self.points[batch];
        let tiles = points.len().div_ceil(TILE);
        let weight = 1.0 / points.len() as f32;
        let (device, loss) = (&self.device, &self.options.loss);
        let (parameters, transposed) = (&self.parameters, &self.transposed);
        let (conditioning, working_sets) = (&self.conditioning, &self.tiles);
        let chunks = &mut self.chunks[..count];
        let run = |(index, chunk): (usize, &mut Chunk)| {
            let mut tile = own_tile(working_sets);
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
        let iteration = self.report.iterations + 1;
        match self.options.keep {
            Keep::Best if loss <= self.report.best_loss && !stop => {
                self.report.best_loss = loss;
                self.report.best_iteration = iteration;
                self.kept
                    .as_mut_slice()
                    .copy_from_slice(self.parameters.as_slice());
            }
            Keep::Best => {}
            Keep::Average { decay } => {
                let ramp = self.report.iterations as f32 / (self.report.iterations as f32 + 10.0);
                let fresh = 1.0 - decay.min(ramp);
                let kept = self.kept.as_mut_slice().iter_mut();
                for (kept, parameter) in kept.zip(self.parameters.as_slice()) {
                    *kept += fresh * (parameter - *kept);
                }
                let before = if iteration == 1 {
                    loss
                } else {
                    self.report.best_loss
                };
                self.report.best_loss = before + f64::from(fresh) * (loss - before);
                self.report.best_iteration = iteration;
            }
        }
    }

    /// Adds the chunks' gradients in order and steps the parameters.
    fn step(&mut self, chunks: usize) {
        let done = self.report.iterations as f64 / self.options.max_iterations as f64;
        let share = match self.options.decay {
            Decay::Constant => 1.0,
            Decay::Cosine => 0.5 + 0.5 * (core::f64::consts::PI * done).cos(),
        };
        let rate = f64::from(self.options.learning_rate) * share;
        let adam = AdamStep::new(self.report.iterations + 1, rate);
        let chunks = &self.chunks[..chunks];
        let [means, squares] = &mut self.moments;
        let parameters = self.parameters.as_mut_slice().par_chunks_mut(SLICE);
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
        transpose_middle_layers(&self.parameters, &mut self.transposed);
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

/// The calling thread's working set.
fn own_tile(tiles: &[Mutex<Tile>]) -> MutexGuard<'_, Tile> {
    let thread = rayon::current_thread_index().unwrap_or(0);
    tiles[thread].lock().unwrap_or_else(PoisonError::into_inner)
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
            let Some((loss, stop)) = self.iterate(watch) else {
                return Ok(Advance::Diverged);
            };
            watch.progress(Progress {
                iteration: self.report.iterations,
                max_iterations: self.options.max_iterations,
                loss,
            });
            if stop {
                return Ok(Advance::Converged);
            }
        }
        Ok(Advance::Continues)
    }

    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        let mut flow = vec![[0.0; 3]; points.len()];
        let (device, kept) = (&self.device, &self.kept);
        let (conditioning, working_sets) = (&self.conditioning, &self.tiles);
        device.threads.install(|| {
            flow.par_chunks_mut(TILE)
                .zip(points.par_chunks(TILE))
                .for_each(|(flow, points)| {
                    let mut tile = own_tile(working_sets);
                    tile.load(points.iter().map(|&point| conditioning.apply(point)));
                    device.kernels.forward(kept, &mut tile);
                    flow.copy_from_slice(&tile.outputs[..points.len()]);
                });
        });
        Ok(flow)
    }

    fn report(&self) -> Report {
        self.report
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::backend::Backend;
    use crate::flow::cpu::{CpuBackend, Isa};
    use crate::flow::distance::{DistanceOptions, DistanceTransform};
    use crate::flow::options::Preset;
    use crate::flow::reference::ReferenceNetwork;
    use crate::flow::watch::Unwatched;
    use std::sync::Mutex;

    /// Collects the losses.
    #[derive(Default)]
    struct Losses(Mutex<Vec<f64>>);

    impl Watch for Losses {
        fn progress(&self, progress: Progress) {
            self.0
                .lock()
                .expect("no test panics in it")
                .push(progress.loss);
        }
    }

    /// A wall and a box in front of it, and the same moved by a quarter of a metre.
    fn clouds(points: usize) -> [Vec<Point>; 2] {
        let mut random = Random::new(5);
        let source: Vec<Point> = (0..points)
            .map(|i| {
                let mut across = |width: f64| random.uniform(-width, width) as f32;
                if i % 3 == 0 {
                    [4.0, across(1.0), across(1.0)]
                } else {
                    [8.0, across(6.0), across(2.0)]
                }
            })
            .collect();
        let target = source
            .iter()
            .map(|p| [p[0] + 0.1, p[1] + 0.2, p[2]])
            .collect();
        [source, target]
    }

    fn start(
        isa: Isa,
        threads: usize,
        source: &[Point],
        target: &[Point],
        options: &Options,
    ) -> Box<dyn Trainer> {
        let backend = CpuBackend::with_isa(isa, Some(threads)).expect("threads");
        let transform = backend
            .transform(source, target, &options.distance)
            .expect("small clouds");
        transform.start(source, options).expect("a trainer")
    }

    fn fitted(isa: Isa, threads: usize, options: &Options, steps: usize) -> (Vec<f64>, Vec<Point>) {
        let [source, target] = clouds(1500);
        let losses = Losses::default();
        let mut trainer = start(isa, threads, &source, &target, options);
        trainer
            .advance(steps, &losses)
            .expect("the cpu does not fail");
        let flow = trainer.evaluate(&source).expect("the cpu does not fail");
        (losses.0.into_inner().expect("no test panics in it"), flow)
    }

    #[test]
    fn the_first_losses_are_those_of_the_method_in_double_precision() {
        // Single against double precision, over ten steps that each move every weight by 0.008.
        const TOLERANCE: f64 = 2e-3;
        const STEPS: i32 = 10;
        let [source, target] = clouds(200);
        let options = Preset::Paper.options(None);
        let mut network =
            ReferenceNetwork::read(&Parameters::xavier(&mut Random::stream(options.seed, 0)));
        let distance = DistanceTransform::build(&source, &target, &DistanceOptions::default())
            .expect("small clouds");
        let mut moments = [
            vec![0.0; network.flat().len()],
            vec![0.0; network.flat().len()],
        ];
        let mut expected = Vec::new();
        for iteration in 1..=STEPS {
            let mut gradients = ReferenceNetwork::read(&Parameters::zeros());
            let mut loss = 0.0;
            for point in &source {
                let input = point.map(f64::from);
                let flow = network.forward(input);
                let sample = distance.sample(core::array::from_fn(|a| (input[a] + flow[a]) as f32));
                loss += f64::from(sample.distance) / source.len() as f64;
                let pull = sample.gradient.map(|g| f64::from(g) / source.len() as f64);
                network.backward(input, pull, &mut gradients);
            }
            network.adam_step(&gradients, &mut moments, iteration, 0.008);
            expected.push(loss);
        }
        for isa in Isa::available() {
            let losses = Losses::default();
            let mut trainer = start(isa, 2, &source, &target, &options);
            trainer
                .advance(STEPS as usize, &losses)
                .expect("the cpu does not fail");
            let losses = losses.0.into_inner().expect("no test panics in it");
            assert_eq!(losses.len(), expected.len(), "{isa:?}");
            for (loss, expected) in losses.iter().zip(&expected) {
                let error = (loss - expected).abs() / expected;
                assert!(error < TOLERANCE, "{isa:?}: {losses:?} {expected:?}");
            }
        }
    }

    #[test]
    fn the_number_of_threads_does_not_change_a_bit() {
        for preset in Preset::ALL {
            let mut options = preset.options(None);
            options.batch = options.batch.map(|_| 700);
            let [one, two, five] =
                [1, 2, 5].map(|threads| fitted(Isa::available()[0], threads, &options, 12));
            assert_eq!(one, two, "{preset:?}");
            assert_eq!(one, five, "{preset:?}");
        }
    }

    #[test]
    fn seeds_give_different_fields() {
        let mut options = Preset::Default.options(None);
        let first = fitted(Isa::Portable, 1, &options, 3);
        options.seed = 1;
        assert_ne!(first, fitted(Isa::Portable, 1, &options, 3));
    }

    #[test]
    fn a_zero_start_is_no_flow() {
        let options = Preset::Default.options(None);
        let (_, flow) = fitted(Isa::available()[0], 1, &options, 0);
        assert!(flow.iter().flatten().all(|&f| f == 0.0));
    }

    #[test]
    fn the_best_field_has_the_lowest_loss_and_not_the_last() {
        let mut options = Preset::Paper.options(None);
        options.early_stop = None;
        // Steps this long overshoot after a while.
        options.learning_rate = 0.05;
        let [source, target] = clouds(500);
        let losses = Losses::default();
        let mut trainer = start(Isa::available()[0], 2, &source, &target, &options);
        trainer.advance(40, &losses).expect("the cpu does not fail");
        let losses = losses.0.into_inner().expect("no test panics in it");
        let lowest = losses.iter().copied().fold(f64::INFINITY, f64::min);
        let report = trainer.report();
        assert_eq!(report.best_loss, lowest);
        assert_eq!(losses[report.best_iteration - 1], lowest);
        assert!(
            report.best_iteration < 40,
            "the last iteration was the best: no overshoot"
        );
    }

    #[test]
    fn every_point_is_in_one_batch_of_each_round() {
        let [source, target] = clouds(1500);
        let mut options = Preset::Default.options(None);
        options.batch = Some(400);
        let backend = CpuBackend::new(Some(1)).expect("threads");
        let distance = DistanceTransform::build(&source, &target, &options.distance);
        let device = CpuTransform {
            kernels: backend.kernels,
            threads: backend.threads,
            distance: distance.expect("small clouds"),
        };
        let mut trainer = CpuTrainer::new(device, &source, &options);
        let mut covered = vec![0; 1500];
        for _ in 0..4 {
            let batch = trainer.batch();
            assert!(batch.len() <= 400, "{batch:?}");
            batch.for_each(|point| covered[point] += 1);
            trainer.iterate(&Unwatched);
        }
        assert!(covered.iter().all(|&count| count == 1));
    }
}
