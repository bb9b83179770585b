//! The course of an optimization: where it starts, which points an iteration looks at, and how far
//! it steps. Every backend follows it; computes no network.

use core::ops::Range;

use super::adam::AdamStep;
use super::mlp::{Conditioning, Parameters};
use crate::flow::data::{Point, Random};
use crate::flow::options::{LearningRateSchedule, Options, ResultChoice, Start};

/// Iterations over which the weight of the past in a running average is ramped up.
const RAMP: f32 = 10.0;

/// What every iteration of one optimization does.
pub(crate) struct Schedule {
    pub(crate) options: Options,
    pub(crate) conditioning: Conditioning,
    /// Source points in the order in which batches take them.
    pub(crate) points: Vec<Point>,
}

impl Schedule {
    /// The course over `source`, and the parameters at its start.
    pub(crate) fn new(source: &[Point], options: &Options) -> (Self, Parameters) {
        let mut random = Random::stream(options.seed, 0);
        let mut parameters = Parameters::xavier(&mut random);
        if options.start == Start::ZeroFlow {
            parameters.clear_last_layer();
        }
        let mut points = source.to_vec();
        if options.batch.is_some_and(|batch| batch < points.len()) {
            random.shuffle(&mut points);
        }
        let course = Self {
            options: options.clone(),
            conditioning: Conditioning::new(source, options.inputs),
            points,
        };
        (course, parameters)
    }

    /// Parts that the points are cut into, nearly equal.
    fn parts(&self) -> usize {
        let all = self.points.len();
        let batch = self.options.batch;
        batch.map_or(1, |batch| all.div_ceil(batch.max(1)))
    }

    /// The points of the iteration after `done` others: one part, in turn.
    pub(crate) fn batch(&self, done: usize) -> Range<usize> {
        let (all, parts) = (self.points.len(), self.parts());
        let part = done % parts;
        part * all / parts..(part + 1) * all / parts
    }

    /// Points of the largest batch.
    pub(crate) fn largest_batch(&self) -> usize {
        self.points.len().div_ceil(self.parts())
    }

    /// Adam's step of the iteration after `done` others.
    pub(crate) fn adam(&self, done: usize) -> AdamStep {
        let share = match self.options.decay {
            LearningRateSchedule::Constant => 1.0,
            LearningRateSchedule::Cosine => {
                let done = done as f64 / self.options.max_iterations as f64;
                0.5 + 0.5 * (core::f64::consts::PI * done).cos()
            }
        };
        AdamStep::new(done + 1, f64::from(self.options.learning_rate) * share)
    }

    /// Weight of the present in a running average, in the iteration after `done` others; none
    /// where the best is kept.
    pub(crate) fn fresh(&self, done: usize) -> Option<f32> {
        match self.options.keep {
            ResultChoice::Best => None,
            ResultChoice::Average { decay } => {
                let ramp = done as f32 / (done as f32 + RAMP);
                Some(1.0 - decay.min(ramp))
            }
        }
    }

    /// Ends after `max_iterations` at the latest, and lets the step size fall accordingly.
    pub(crate) fn shorten(&mut self, max_iterations: usize) {
        self.options.max_iterations = self.options.max_iterations.min(max_iterations);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::options::Preset;

    #[test]
    fn every_point_is_in_one_batch_of_each_round() {
        let mut options = Preset::Neural.options(None);
        options.batch = Some(400);
        let (course, _) = Schedule::new(&[[0.0; 3]; 1501], &options);
        let mut covered = vec![0; 1501];
        for done in 8..12 {
            let batch = course.batch(done);
            assert!(batch.len() <= 376, "{batch:?}");
            batch.for_each(|point| covered[point] += 1);
        }
        assert!(covered.iter().all(|&count| count == 1));
    }
}
