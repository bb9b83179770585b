//! The schedule of a fit, common to all models, losses and backends: the points of each iteration,
//! its step size, and which iterations become the result.

use core::ops::Range;

use super::adam::AdamStep;
use crate::flow::data::{Point, Random};
use crate::flow::options::{FieldOptions, LearningRateSchedule, ResultChoice};

/// Iterations over which the weight of the past in a running average is ramped up.
const RAMP: f32 = 10.0;

/// The schedule of one fit.
pub(crate) struct Schedule {
    pub(crate) options: FieldOptions,
    /// Source points in the order of the batches.
    pub(crate) points: Vec<Point>,
}

impl Schedule {
    /// The schedule over `source`, with its batches drawn from `random`.
    pub(crate) fn new(source: &[Point], options: &FieldOptions, random: &mut Random) -> Self {
        let mut points = source.to_vec();
        if options.batch.is_some_and(|batch| batch < points.len()) {
            random.shuffle(&mut points);
        }
        Self {
            options: options.clone(),
            points,
        }
    }

    /// Number of batches that the points are divided into, of nearly equal size.
    fn parts(&self) -> usize {
        let all = self.points.len();
        let batch = self.options.batch;
        batch.map_or(1, |batch| all.div_ceil(batch.max(1)))
    }

    /// The points of the iteration after `done` others: the batches in turn.
    pub(crate) fn batch(&self, done: usize) -> Range<usize> {
        let (all, parts) = (self.points.len(), self.parts());
        let part = done % parts;
        part * all / parts..(part + 1) * all / parts
    }

    /// Points of the largest batch.
    pub(crate) fn largest_batch(&self) -> usize {
        self.points.len().div_ceil(self.parts())
    }

    /// The Adam step of the iteration after `done` others.
    pub(crate) fn adam(&self, done: usize) -> AdamStep {
        let share = match self.options.learning_rate_schedule {
            LearningRateSchedule::Constant => 1.0,
            LearningRateSchedule::Cosine => {
                let done = done as f64 / self.options.max_iterations as f64;
                0.5 + 0.5 * (core::f64::consts::PI * done).cos()
            }
        };
        AdamStep::new(done + 1, f64::from(self.options.learning_rate) * share)
    }

    /// Weight of the current parameters in the running average, in the iteration after `done`
    /// others; none if the result is the best iteration.
    pub(crate) fn ema_weight(&self, done: usize) -> Option<f32> {
        match self.options.result {
            ResultChoice::Best => None,
            ResultChoice::Average { decay } => {
                let ramp = done as f32 / (done as f32 + RAMP);
                Some(1.0 - decay.min(ramp))
            }
        }
    }

    /// Limits the fit to `max_iterations`; a cosine schedule then falls to zero at that iteration.
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
        let mut options = Preset::Neural.field();
        options.batch = Some(400);
        let schedule = Schedule::new(&[[0.0; 3]; 1501], &options, &mut Random::new(0));
        let mut covered = vec![0; 1501];
        for done in 8..12 {
            let batch = schedule.batch(done);
            assert!(batch.len() <= 376, "{batch:?}");
            batch.for_each(|point| covered[point] += 1);
        }
        assert!(covered.iter().all(|&count| count == 1));
    }
}
