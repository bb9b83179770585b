//! The measurement of one method on one pair.

use std::time::Instant;

use super::devices::Devices;
use crate::flow::evaluate::{EvaluateError, Metrics, evaluate};
use crate::flow::{
    Control, FlowError, Interrupt, Options, Problem, Progress, StopReason, estimate, predict_cost,
};
use crate::formats::{Pair, PairTruth};
use crate::scores::truth_of;

/// The result of one run.
#[derive(Clone, Debug)]
pub(super) struct Run {
    /// The device that the method ran on.
    pub(super) device: String,
    pub(super) metrics: Metrics,
    /// Seconds before the first iteration, of the distance queries or correspondences, of the
    /// network or other model, and in all.
    pub(super) precompute: f64,
    pub(super) query: f64,
    pub(super) network: f64,
    pub(super) total: f64,
    /// Iterations; none for the object search.
    pub(super) iterations: Option<usize>,
    /// Bound of the memory, bytes.
    pub(super) bytes: usize,
    /// Bytes of the distance transform or of the target; none for the object search.
    pub(super) target_bytes: Option<usize>,
    /// Whether the budget ended the run.
    pub(super) is_cut: bool,
}

/// A control with a budget that does not change the method: the run ends when it is spent.
pub(super) struct Budget<'a> {
    began: Instant,
    seconds: Option<f64>,
    terminal: &'a dyn Control,
}

impl<'a> Budget<'a> {
    pub(super) fn new(seconds: Option<f64>, terminal: &'a dyn Control) -> Self {
        Self {
            began: Instant::now(),
            seconds,
            terminal,
        }
    }
}

impl Control for Budget<'_> {
    fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    fn interrupt(&self) -> Option<Interrupt> {
        let is_spent = self.seconds.is_some_and(|most| self.seconds() > most);
        is_spent.then_some(Interrupt::Deadline)
    }

    fn progress(&self, progress: Progress) {
        self.terminal.progress(progress);
    }
}

/// Why a run has no result.
#[derive(Debug, thiserror::Error)]
pub(super) enum RunError {
    /// The method failed or refused the pair.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// The flow could not be scored.
    #[error(transparent)]
    Score(#[from] EvaluateError),
}

impl RunError {
    /// Whether the pair or the options are at fault.
    pub(super) fn is_input(&self) -> bool {
        match self {
            Self::Flow(error) => error.is_input(),
            Self::Score(_) => true,
        }
    }
}

/// A pair with its truth, and the name of its file.
pub(super) struct Subject {
    pub(super) name: String,
    pub(super) pair: Pair,
    pub(super) truth: PairTruth,
}

/// Runs a method on a pair and scores it.
pub(super) fn measure(
    devices: &Devices,
    subject: &Subject,
    options: &Options,
    control: &Budget<'_>,
) -> Result<Run, RunError> {
    let Subject { pair, truth, .. } = subject;
    let mut problem = Problem::pair(&pair.source, &pair.target);
    problem.ground = pair
        .ground
        .as_ref()
        .map(|ground| [ground.source.as_slice(), &ground.target]);
    let cost = predict_cost(&problem, options)?;
    let backend = devices.of(options);
    let estimate = estimate(backend, &problem, options, control)?;
    let query = estimate.fit().map_or(0.0, |fit| fit.query_seconds);
    Ok(Run {
        device: backend.name(),
        metrics: evaluate(&estimate.flow, &estimate.valid, &truth_of(truth, pair))?,
        precompute: estimate.precompute_seconds,
        query,
        network: estimate.method_seconds() - query,
        total: estimate.total_seconds,
        iterations: estimate.fit().map(|fit| fit.iterations),
        bytes: cost.bytes,
        target_bytes: estimate.fit().map(|fit| fit.distance_bytes),
        is_cut: estimate.stop_reason == StopReason::Deadline,
    })
}
