//! The schedule of a fit, common to all models, losses and backends: the points of each iteration,
//! its step size, and which iterations become the result.

use core::ops::Range;

use super::adam::AdamStep;
use crate::flow::data::{Point, Random};
use crate::flow::options::{BatchGrowth, FieldOptions, LearningRateSchedule, ResultChoice};

/// Iterations over which the weight of the past in a running average is ramped up.
const RAMP: f32 = 10.0;

/// No cloud needs more doublings.
pub(crate) const MOST_DOUBLINGS: u32 = usize::BITS - 1;

/// How far the batches have grown.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct GrowthState {
    /// How often the batch has doubled.
    pub(crate) doublings: u32,
    /// The loss at the last doubling, or of the first iteration; none before it.
    pub(crate) loss: Option<f32>,
}

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
    fn parts(&self, growth: GrowthState) -> usize {
        let all = self.points.len();
        let size = self.options.batch.map_or(all, |batch| {
            batch.max(1).saturating_mul(1 << growth.doublings)
        });
        all.div_ceil(size.max(1)).max(1)
    }

    /// The points of the iteration after `done` others: the batches in turn.
    pub(crate) fn batch(&self, done: usize, growth: GrowthState) -> Range<usize> {
        let (all, parts) = (self.points.len(), self.parts(growth));
        let part = done % parts;
        part * all / parts..(part + 1) * all / parts
    }

    /// Points of the largest batch, as long as the batches do not grow further.
    pub(crate) fn largest_batch(&self, growth: GrowthState) -> usize {
        self.points.len().div_ceil(self.parts(growth))
    }

    /// Whether the batches can still grow.
    pub(crate) fn is_growing(&self, growth: GrowthState) -> bool {
        self.options.growth.is_some() && self.parts(growth) > 1
    }

    /// The growth after `done` iterations, the last of them with `loss`. Doubles where that is due,
    /// and where the fit has `stalled`.
    pub(crate) fn grown(
        &self,
        growth: GrowthState,
        done: usize,
        loss: f32,
        stalled: bool,
    ) -> GrowthState {
        let Some(rule) = self.options.growth.filter(|_| self.is_growing(growth)) else {
            return growth;
        };
        let since = growth.loss.unwrap_or(loss);
        let due = match rule {
            BatchGrowth::Iterations(every) => done.is_multiple_of(every.max(1)),
            BatchGrowth::LossFall(share) => loss < since * (1.0 - share.clamp(0.0, 1.0)),
        };
        if due || stalled {
            GrowthState {
                doublings: growth.doublings + 1,
                loss: Some(loss),
            }
        } else {
            GrowthState {
                loss: Some(since),
                ..growth
            }
        }
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
            let batch = schedule.batch(done, GrowthState::default());
            assert!(batch.len() <= 376, "{batch:?}");
            batch.for_each(|point| covered[point] += 1);
        }
        assert!(covered.iter().all(|&count| count == 1));
    }

    #[test]
    fn batches_double_until_they_hold_all_points() {
        let mut options = Preset::Paper.field();
        options.batch = Some(100);
        for (rule, losses, sizes) in [
            (
                BatchGrowth::Iterations(2),
                [1.0; 7],
                [100, 200, 200, 400, 400, 800, 800],
            ),
            (
                BatchGrowth::LossFall(0.5),
                [1.0, 0.6, 0.4, 0.3, 0.1, 0.01, 0.001],
                [100, 100, 200, 200, 400, 800, 800],
            ),
        ] {
            options.growth = Some(rule);
            let schedule = Schedule::new(&[[0.0; 3]; 800], &options, &mut Random::new(0));
            let mut growth = GrowthState::default();
            let mut seen = Vec::new();
            for (done, loss) in losses.into_iter().enumerate() {
                growth = schedule.grown(growth, done + 1, loss, false);
                seen.push(schedule.largest_batch(growth));
            }
            assert_eq!(seen, sizes, "{rule:?}");
            assert!(!schedule.is_growing(growth));
        }
    }

    #[test]
    fn a_stalled_fit_doubles_its_batch() {
        let mut options = Preset::Paper.field();
        options.batch = Some(100);
        options.growth = Some(BatchGrowth::Iterations(1000));
        let schedule = Schedule::new(&[[0.0; 3]; 1000], &options, &mut Random::new(0));
        let growth = schedule.grown(GrowthState::default(), 3, 1.0, true);
        assert_eq!(growth.doublings, 1);
    }
}
