//! Options of the fit of a field.

use std::borrow::Cow;

use super::loss::{ChamferOptions, DistanceLossOptions, LossOptions, NearestSearch};
use super::model::{
    InputNormalization, LinearOptions, ModelOptions, NetworkOptions, Precision, Start,
};
use super::partition::PartitionOptions;
use crate::flow::data::Point;

/// Options of the fit of a field to one pair.
///
/// The field is a model from a point to its displacement. Adam minimizes the mean loss of the
/// displaced source points (FNSF Section 3).
#[derive(Clone, Debug, PartialEq)]
pub struct FieldOptions {
    /// The model of the field.
    pub model: ModelOptions,
    /// The loss that the field is fitted to.
    pub loss: LossOptions,
    /// A field of its own for each cluster of the source; none for one field. The CPU alone has it.
    pub partition: Option<PartitionOptions>,
    /// Weight of the local consistency of NSFP++: the mean over the points of the sum of their
    /// flow's distances from all other flows, metres. Zero for none. The CPU alone has it.
    pub consistency_weight: f32,
    /// Learning rate (Adam's step size) of the first iteration.
    pub learning_rate: f32,
    /// Schedule of the learning rate over the iterations.
    pub learning_rate_schedule: LearningRateSchedule,
    /// Maximum number of points per iteration (batch size); none for all points. Zero counts as 1.
    /// If there are more points, they are shuffled once and cut into nearly equal batches, which
    /// are used in turn. Larger batches give less noisy gradients at a proportionally higher cost
    /// per iteration.
    pub batch: Option<usize>,
    /// Growth of the batch during the fit, from `batch` points to all; none for a constant batch.
    /// The CPU alone has it.
    pub growth: Option<BatchGrowth>,
    /// Which iteration's parameters become the result.
    pub result: ResultChoice,
    /// Early stopping before `max_iterations`; none to do all iterations.
    pub early_stop: Option<EarlyStopOptions>,
    /// Maximum number of iterations; with zero the result is the initial model. The cosine
    /// schedule reaches a learning rate of zero there. Under a deadline the same work may be
    /// divided into more iterations of smaller batches.
    pub max_iterations: usize,
    /// Bird's eye view: the fit sees the points' x and y alone, and the flow has no z, as in the
    /// ablation of FNSF. For a network on the CPU.
    pub bev: bool,
    /// Warm start: in a sequence, the fit of a pair starts from the field of the previous pair, and
    /// the registration from its ego motion. With none, each pair starts from new weights and is
    /// independent of the others.
    pub warm_start: Option<WarmStart>,
}

impl FieldOptions {
    /// FNSF with the settings of its published code, for full clouds or for sampled ones.
    pub(crate) fn published(sampled: bool) -> Self {
        let (learning_rate, patience) = if sampled { (0.01, 5) } else { (0.008, 10) };
        Self {
            model: ModelOptions::Network(NetworkOptions::published()),
            loss: LossOptions::Distance(DistanceLossOptions::published()),
            partition: None,
            consistency_weight: 0.0,
            learning_rate,
            learning_rate_schedule: LearningRateSchedule::Constant,
            batch: None,
            growth: None,
            result: ResultChoice::Best,
            early_stop: Some(EarlyStopOptions {
                patience,
                min_delta: 1e-3,
            }),
            max_iterations: 5000,
            bev: false,
            warm_start: None,
        }
    }

    /// Options of the preset `neural`. `docs/experiments/field.md` measures the effect of each
    /// choice.
    pub(super) fn neural() -> Self {
        Self {
            loss: LossOptions::Distance(DistanceLossOptions {
                margin_m: 0.1,
                margin_quantile: Some(0.9),
                truncation_m: Some(1.0),
                flow_penalty: 0.02,
                ..DistanceLossOptions::published()
            }),
            model: ModelOptions::Network(NetworkOptions {
                inputs: InputNormalization::Centered { scale_m: 10.0 },
                start: Start::ZeroFlow,
                precision: Precision::F32,
                cycle: false,
            }),
            partition: None,
            consistency_weight: 0.0,
            learning_rate: 0.004,
            learning_rate_schedule: LearningRateSchedule::Cosine,
            batch: Some(2048),
            growth: None,
            result: ResultChoice::Average { decay: 0.9 },
            early_stop: None,
            max_iterations: 150,
            bev: false,
            warm_start: Some(WarmStart {
                max_iterations: 75,
                learning_rate: 0.004,
            }),
        }
    }

    /// One network and the truncated Chamfer distance, as the baseline of FNSF's comparison. Rate
    /// and stopping rule are those of NSFP's published code for sampled clouds, which end a fit after
    /// as many iterations as FNSF's tables imply. The truncation is that of its text.
    pub(super) fn nsfp(search: NearestSearch) -> Self {
        Self {
            loss: LossOptions::Chamfer(ChamferOptions::published(search)),
            learning_rate: 0.008,
            early_stop: Some(EarlyStopOptions {
                patience: 30,
                min_delta: 1e-4,
            }),
            ..Self::published(false)
        }
    }

    /// These options with the cycle consistency of NSFP.
    pub(super) fn with_cycle(mut self) -> Self {
        if let Some(network) = self.network_mut() {
            network.cycle = true;
        }
        self
    }

    /// Whether the fit has kernels for a GPU: that of one network or linear model to a distance
    /// transform or, by all distances, to a Chamfer distance, with a constant batch, without a
    /// partition, in three dimensions.
    pub fn runs_on_gpu(&self) -> bool {
        let by_loss = match &self.loss {
            LossOptions::Distance(_) => None,
            LossOptions::Chamfer(options) => options.lacks_gpu_kernels(),
        };
        by_loss.is_none() && self.partition.is_none() && self.lacks_gpu_kernels().is_none()
    }

    /// Whether the fit has kernels in half precision: that of a network to a distance transform.
    pub fn runs_in_half(&self) -> bool {
        self.network().is_some() && self.loss.distance().is_some() && self.runs_on_gpu()
    }

    /// What of the fit of one field a GPU cannot compute; none if it can compute all, apart from the
    /// loss.
    pub(crate) fn lacks_gpu_kernels(&self) -> Option<&'static str> {
        let cpu_alone = [
            (
                self.has_cycle(),
                "the cycle of two networks is computed on the CPU alone",
            ),
            (
                self.consistency_weight > 0.0,
                "the local consistency is computed on the CPU alone",
            ),
            (self.growth.is_some(), "batches grow on the CPU alone"),
            (self.bev, "the bird's eye view is computed on the CPU alone"),
        ];
        let lacking = cpu_alone.into_iter().find(|(asked, _)| *asked);
        lacking.map(|(_, text)| text)
    }

    /// These options with the partition of NSFP++, its cycle and its local consistency.
    pub(super) fn by_cluster(self) -> Self {
        Self {
            partition: Some(PartitionOptions::published()),
            consistency_weight: 0.05,
            ..self.with_cycle()
        }
    }

    /// The points as the fit sees them: with z = 0 in bird's eye view.
    pub(crate) fn seen<'a>(&self, points: &'a [Point]) -> Cow<'a, [Point]> {
        if self.bev {
            Cow::Owned(points.iter().map(|&[x, y, _]| [x, y, 0.0]).collect())
        } else {
            Cow::Borrowed(points)
        }
    }

    /// Whether the fit has the cycle consistency of NSFP.
    pub fn has_cycle(&self) -> bool {
        self.network().is_some_and(|network| network.cycle)
    }

    /// These options with the linear model, and the rate and stopping rule of its published code.
    pub(super) fn linear(self) -> Self {
        Self {
            model: ModelOptions::Linear(LinearOptions::published()),
            learning_rate: 0.03,
            early_stop: Some(EarlyStopOptions {
                patience: 10,
                min_delta: 1e-3,
            }),
            ..self
        }
    }

    /// The options of the coordinate network; none for another model.
    pub fn network(&self) -> Option<&NetworkOptions> {
        match &self.model {
            ModelOptions::Network(options) => Some(options),
            ModelOptions::Linear(_) => None,
        }
    }

    /// Mutable access to the options of the coordinate network; none for another model.
    pub fn network_mut(&mut self) -> Option<&mut NetworkOptions> {
        match &mut self.model {
            ModelOptions::Network(options) => Some(options),
            ModelOptions::Linear(_) => None,
        }
    }

    /// Expected number of iterations of a fit without a deadline, for the prediction of its cost.
    ///
    /// It is `max_iterations` without early stopping. Otherwise it is at most 60 for a network and a
    /// distance transform, 250 for a network and a Chamfer distance, and 80 for the linear model.
    /// The published stopping rules ended the measured fits after 36 to 115, 200 to 240, and 70 to 95
    /// iterations.
    pub fn expected_iterations(&self) -> usize {
        let stopped = match (&self.model, &self.loss) {
            (ModelOptions::Linear(_), _) => 80,
            (ModelOptions::Network(_), LossOptions::Distance(_)) => 60,
            (ModelOptions::Network(_), LossOptions::Chamfer(_)) => 250,
        };
        match self.early_stop {
            None => self.max_iterations,
            Some(_) => self.max_iterations.min(stopped),
        }
    }

    /// These options for a fit with a warm start.
    pub(crate) fn warmed(&self, warm_start: WarmStart) -> Self {
        Self {
            max_iterations: warm_start.max_iterations.min(self.max_iterations),
            learning_rate: warm_start.learning_rate,
            ..self.clone()
        }
    }

    /// These options for a run that its deadline shortens: batches of `batch` points, and a
    /// learning rate that falls to zero within `iterations`.
    pub(crate) fn under_deadline(&self, batch: usize, iterations: usize) -> Self {
        Self {
            learning_rate_schedule: LearningRateSchedule::Cosine,
            batch: Some(batch),
            growth: None,
            result: ResultChoice::Average { decay: 0.9 },
            early_stop: None,
            max_iterations: iterations,
            ..self.clone()
        }
    }
}

/// Options of a fit that starts from the field of the previous pair. They replace the options of
/// the same name in [`FieldOptions`].
///
/// The fit starts from that field under two conditions. The field must have a lower mean loss on
/// the new pair than zero residual motion. Both pairs or neither of them must have an ego motion.
/// Otherwise the fit starts from new weights, and these options are ignored.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WarmStart {
    /// Maximum number of iterations. Values above [`FieldOptions::max_iterations`] count as that.
    pub max_iterations: usize,
    /// Learning rate (Adam's step size) of the first iteration.
    pub learning_rate: f32,
}

/// Limits of a fit that its deadline shortens.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DeadlineLimits {
    /// Smallest and largest batch, points. Half of the smallest is no cheaper on two cores.
    pub(crate) batches: [usize; 2],
    /// Target number of iterations, achieved by a smaller batch. If the time allows more with the
    /// largest batch, more are done.
    pub(crate) iterations: usize,
    /// Minimum number of iterations. With fewer, the fit is skipped, because its field would be
    /// worse than none.
    pub(crate) least_iterations: usize,
}

impl DeadlineLimits {
    /// The limits, with an ego motion as a fallback (`ego`) or without one.
    pub(crate) fn new(ego: bool) -> Self {
        Self {
            batches: [768, 2048],
            iterations: 150,
            least_iterations: if ego { 40 } else { 10 },
        }
    }
}

/// Growth of the batch during a fit: when it doubles. It stops at all points.
///
/// FNSF's Section 5 samples few points first and more later, without numbers; these are ours. Early
/// stopping while points are missing doubles the batch instead of ending the fit, and with each
/// doubling early stopping and the best iteration begin anew.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BatchGrowth {
    /// After every so many iterations. Zero counts as 1.
    Iterations(usize),
    /// Each time the mean loss has fallen by this share since the last doubling, 0 to 1. Values
    /// outside are clamped.
    LossFall(f32),
}

/// Schedule of the learning rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LearningRateSchedule {
    /// The initial learning rate at every iteration.
    Constant,
    /// Half a cosine, from the initial learning rate to zero at `max_iterations`.
    Cosine,
}

/// Which iteration's parameters become the result.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ResultChoice {
    /// Those of the iteration with the lowest loss; of equal losses, the latest. As in the
    /// published code, the iteration at which early stopping ends the fit does not count.
    Best,
    /// The exponential moving average of the parameters over the iterations.
    Average {
        /// Weight of the previous average at each iteration, 0 to 1. After `n` iterations it is
        /// limited to `n / (n + 10)`. Larger values average over more iterations.
        decay: f32,
    },
}

/// Early stopping, as in the published code. An iteration is progress if its mean loss is more than
/// `min_delta` below that of the last progress; the first iteration counts as progress. A fit
/// ends after `patience` successive iterations without progress.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EarlyStopOptions {
    /// Number of successive iterations without progress that end the fit. Zero counts as 1. Larger
    /// values give longer fits.
    pub patience: usize,
    /// Decrease of the mean loss that counts as progress, in the unit of the loss
    /// ([`LossOptions::unit`]). Larger values end the fit earlier.
    pub min_delta: f64,
}
