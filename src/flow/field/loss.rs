//! The loss of an iteration: a value for every deformed point and its derivative with respect to
//! the flow.
//!
//! [`Loss`] is the interface to the fit. [`DistanceLoss`] is FNSF's, of one deformed point in the
//! distance transform. Every backend implements its formulas:
//! `clamp(D(p + f), margin, truncation) + penalty * |f|`. With the published settings it is just
//! `D(p + f)`, FNSF eq. 6. The Chamfer distance is in `chamfer.rs`, and the cycle of NSFP in
//! `cycle.rs`.

use core::ops::Range;
use std::sync::Arc;

use crate::flow::data::{Control, Interrupt, Point};
use crate::flow::distance::{DistanceTransform, Sample};
use crate::flow::options::DistanceLossOptions;

/// Flows shorter than this are penalized quadratically, so that the derivative is continuous.
const SMALL_FLOW_M: f32 = 1e-3;

/// What a model computes for a point: its flow, or its flow and the flow back from where it leads.
/// The derivative of a loss with respect to it has the same type.
pub(crate) trait Output: Copy + Default + Send + Sync {
    /// All components times `factor`.
    fn scaled(self, factor: f32) -> Self;

    /// The flow.
    fn flow(self) -> Point;

    /// The same with `more` added to the flow.
    fn plus_flow(self, more: Point) -> Self;
}

/// A flow, metres.
impl Output for Point {
    #[inline]
    fn scaled(self, factor: f32) -> Self {
        self.map(|component| component * factor)
    }

    #[inline]
    fn flow(self) -> Point {
        self
    }

    #[inline]
    fn plus_flow(self, more: Point) -> Self {
        core::array::from_fn(|a| self[a] + more[a])
    }
}

/// A flow, and the flow back from the deformed point, metres.
impl Output for [Point; 2] {
    #[inline]
    fn scaled(self, factor: f32) -> Self {
        self.map(|flow| flow.scaled(factor))
    }

    #[inline]
    fn flow(self) -> Point {
        self[0]
    }

    #[inline]
    fn plus_flow(self, more: Point) -> Self {
        [self[0].plus_flow(more), self[1]]
    }
}

/// The loss of one point and its derivative with respect to the output of the model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PointLoss<O = Point> {
    pub(crate) value: f32,
    pub(crate) gradient: O,
}

/// The points of one iteration.
pub(crate) struct Batch<'a, O = Point> {
    pub(crate) points: &'a [Point],
    /// Which of the source's points they are, in the order of the schedule.
    pub(crate) range: &'a Range<usize>,
    /// Number of iterations done before.
    pub(crate) done: usize,
    /// Computes the output of the model at each point.
    pub(crate) outputs: &'a dyn Fn() -> Vec<O>,
}

/// A loss that a field can be fitted to. The fit minimizes the mean of [`Self::at`] over the points
/// of each iteration. `O` is the output of the models that it suits.
pub(crate) trait Loss<O = Point>: Send + Sync {
    /// Whether it couples the points, so that [`Self::prepare`] has something to do.
    const COUPLES: bool;

    /// Prepares an iteration over `batch`. A loss that couples the points, such as the Chamfer
    /// distance, finds its correspondences here.
    ///
    /// # Errors
    /// The interrupt of `control`, which abandons the iteration.
    fn prepare(&mut self, batch: &Batch<'_, O>, control: &dyn Control) -> Result<(), Interrupt>;

    /// Whether the iteration after `done` others depends on what an earlier one prepared.
    fn depends_on_earlier(&self, _done: usize) -> bool {
        false
    }

    /// The loss of `point` with `output`. `index` is that of the point among those of the iteration.
    fn at(&self, index: usize, point: Point, output: O) -> PointLoss<O>;
}

/// The loss of FNSF, eq. 6, with a margin, a truncation and a penalty on the flow: each deformed
/// point's distance to the target, metres, by the target's distance transform.
pub(crate) struct DistanceLoss {
    pub(crate) options: DistanceLossOptions,
    pub(crate) distance: Arc<DistanceTransform>,
}

impl Loss for DistanceLoss {
    const COUPLES: bool = false;

    /// Nothing: the points are independent of each other.
    fn prepare(&mut self, _: &Batch<'_>, _: &dyn Control) -> Result<(), Interrupt> {
        Ok(())
    }

    #[inline]
    fn at(&self, _: usize, point: Point, flow: Point) -> PointLoss {
        let deformed = core::array::from_fn(|a| point[a] + flow[a]);
        self.options.at(point, self.distance.sample(deformed), flow)
    }
}

impl DistanceLossOptions {
    /// The loss of `point` with `flow`, where `sample` is the distance transform at the deformed
    /// point.
    #[inline]
    pub(crate) fn at(&self, point: Point, sample: Sample, flow: Point) -> PointLoss {
        let [margin, truncation] = self.bounds(point);
        let pulled = sample.distance > margin && sample.distance < truncation;
        let pull = if pulled { 1.0 } else { 0.0 };
        let shrink = self.flow_penalty / length(flow).max(SMALL_FLOW_M);
        PointLoss {
            value: self.value(point, sample.distance, flow),
            gradient: core::array::from_fn(|a| pull * sample.gradient[a] + shrink * flow[a]),
        }
    }

    /// The loss of `point` with `flow`, where the deformed point lies at `distance` from the
    /// target, metres.
    #[inline]
    pub(crate) fn value(&self, point: Point, distance: f32, flow: Point) -> f32 {
        let [margin, truncation] = self.bounds(point);
        let length = length(flow);
        let penalized = if length > SMALL_FLOW_M {
            length - SMALL_FLOW_M / 2.0
        } else {
            length * length / (2.0 * SMALL_FLOW_M)
        };
        distance.max(margin).min(truncation) + self.flow_penalty * penalized
    }

    /// The margin and the truncation: the distances between which `point` is attracted, metres.
    #[inline]
    fn bounds(&self, point: Point) -> [f32; 2] {
        let margin = self.margin_m.max(self.margin_slope * length(point));
        [margin, self.truncation_m.unwrap_or(f32::INFINITY)]
    }
}

/// Euclidean length.
#[inline]
pub(crate) fn length(vector: Point) -> f32 {
    vector.iter().map(|x| x * x).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The loss in a distance field of constant slope: finite differences are exact, and the only
    /// kinks are the loss's own.
    fn value(options: &DistanceLossOptions, flow: [f64; 3]) -> f64 {
        f64::from(loss(options, flow).value)
    }

    fn loss(options: &DistanceLossOptions, flow: [f64; 3]) -> PointLoss {
        let gradient = [0.6f32, 0.0, -0.8];
        let flow = flow.map(|f| f as f32);
        let distance = 0.5 + gradient.iter().zip(flow).map(|(g, f)| g * f).sum::<f32>();
        options.at([0.0; 3], Sample { distance, gradient }, flow)
    }

    #[test]
    fn the_gradient_is_the_finite_difference_of_the_value() {
        // Single precision resolves 6e-8 of a value near 1. With steps of 1e-3 that is a slope
        // error of 6e-5.
        const TOLERANCE: f64 = 5e-4;
        const STEP: f64 = 1e-3;
        let options = DistanceLossOptions {
            margin_m: 0.1,
            truncation_m: Some(2.0),
            flow_penalty: 0.3,
            ..DistanceLossOptions::published()
        };
        for flow in [
            [0.2, 0.1, -0.3],
            [-1.0, 0.5, 0.25],
            [3.0, 0.0, 0.0],
            [-0.5, 0.2, 0.4],
        ] {
            let gradient = loss(&options, flow).gradient;
            for axis in 0..3 {
                let mut ahead = flow;
                let mut behind = flow;
                ahead[axis] += STEP;
                behind[axis] -= STEP;
                let slope = (value(&options, ahead) - value(&options, behind)) / (2.0 * STEP);
                let error = (slope - f64::from(gradient[axis])).abs();
                assert!(
                    error < TOLERANCE,
                    "axis {axis} at {flow:?}: {slope} {gradient:?}"
                );
            }
        }
    }

    #[test]
    fn the_published_loss_is_the_distance_itself() {
        let options = DistanceLossOptions::published();
        let sample = Sample {
            distance: 0.7,
            gradient: [0.0, 1.0, 0.0],
        };
        let loss = options.at([0.0; 3], sample, [5.0, 5.0, 5.0]);
        assert_eq!(
            loss,
            PointLoss {
                value: 0.7,
                gradient: [0.0, 1.0, 0.0]
            }
        );
    }

    #[test]
    fn points_within_the_margin_and_beyond_the_truncation_are_not_pulled() {
        let options = DistanceLossOptions {
            margin_m: 0.1,
            truncation_m: Some(2.0),
            ..DistanceLossOptions::published()
        };
        for (distance, value) in [(0.05, 0.1), (3.0, 2.0)] {
            let loss = options.at(
                [0.0; 3],
                Sample {
                    distance,
                    gradient: [1.0; 3],
                },
                [0.0; 3],
            );
            assert_eq!(
                loss,
                PointLoss {
                    value,
                    gradient: [0.0; 3]
                }
            );
        }
    }

    #[test]
    fn the_margin_grows_with_range() {
        let options = DistanceLossOptions {
            margin_m: 0.1,
            margin_slope: 0.01,
            ..DistanceLossOptions::published()
        };
        let sample = Sample {
            distance: 0.3,
            gradient: [1.0, 0.0, 0.0],
        };
        let near = options.at([20.0, 0.0, 0.0], sample, [0.0; 3]);
        let far = options.at([0.0, 40.0, 0.0], sample, [0.0; 3]);
        assert_eq!(near.gradient, sample.gradient);
        assert!((far.value - 0.4).abs() < 1e-6, "{far:?}");
        assert_eq!(far.gradient, [0.0; 3]);
    }
}
