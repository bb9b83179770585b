//! The fit of a field: forward pass, distance query, backward pass and Adam until a stopping
//! criterion. FNSF Section 3: `theta* = argmin mean_p D(p + g(p; theta))`.

use super::backend::{Advance, Backend, FitReport, Trainer};
use super::budget::{Loop, Prepared, Throughput, evaluate};
use super::error::FitError;
use super::fitted::FittedField;
use super::loss::length;
use super::snapshot::{Snapshot, TrainerState};
use super::warm_start::{Prior, warm_start};
use crate::flow::data::{Control, Interrupt, Point, RigidTransform, StopReason};
use crate::flow::options::{DeadlineLimits, FieldOptions};

/// Most iterations of one call to a backend.
const STEPS_AT_ONCE: usize = 64;

/// One fit of a field to a pair.
pub(crate) struct Fit<'a> {
    pub(crate) backend: &'a dyn Backend,
    /// The field of the preceding pair, for a warm start.
    pub(crate) prior: Option<Prior<'a>>,
    /// The source, transformed by the ego motion if there is one, metres.
    pub(crate) aligned: &'a [Point],
    /// The ego motion that was applied to the source, target_from_source.
    pub(crate) ego: Option<&'a RigidTransform>,
    pub(crate) options: &'a FieldOptions,
    pub(crate) seed: u64,
    /// Computes the identity of the fit for its snapshots.
    pub(crate) identity: &'a dyn Fn() -> u64,
    pub(crate) prepared: &'a Prepared,
    pub(crate) control: &'a dyn Control,
}

/// A fitted field and its flow at the source's points.
pub(crate) struct Fitted {
    /// N x 3: residual flow of each aligned source point, metres.
    pub(crate) residual: Vec<Point>,
    /// The field; none if there was no time for an iteration.
    pub(crate) field: Option<FittedField>,
    pub(crate) report: FitReport,
    /// The maximum number of iterations, as shortened by the deadline.
    pub(crate) max_iterations: usize,
    pub(crate) stop_reason: StopReason,
    /// When the first iteration could begin, seconds of the control's clock.
    pub(crate) precomputed_at: f64,
}

impl Fitted {
    /// Zero flow without a field, for a fit without enough time.
    pub(crate) fn nothing(points: usize, control: &dyn Control) -> Self {
        Self {
            residual: vec![[0.0; 3]; points],
            field: None,
            max_iterations: 0,
            report: FitReport {
                iterations: 0,
                best_iteration: 0,
                best_loss: f64::INFINITY,
                query_seconds: 0.0,
            },
            stop_reason: StopReason::Deadline,
            precomputed_at: control.seconds(),
        }
    }
}

/// A trainer before its first iteration, and the options that fit in the time left.
struct Started<'a> {
    trainer: Box<dyn Trainer + 'a>,
    options: FieldOptions,
    throughput: Option<Throughput>,
    /// Whether the deadline has altered the fit.
    cut: bool,
}

impl Fit<'_> {
    /// Fits from the start, or resumes from `state`.
    ///
    /// # Errors
    /// [`FitError`] if the control cancels, the loss is not finite or the device fails.
    pub(crate) fn run(&self, state: Option<TrainerState>) -> Result<Fitted, FitError> {
        let Some(mut started) = self.start(state)? else {
            return Ok(Fitted::nothing(self.aligned.len(), self.control));
        };
        let precomputed_at = self.control.seconds();
        let stop_reason = self.iterate(&mut started)?;
        if stop_reason == StopReason::Deadline && self.is_worse_than_none(&started) {
            return Ok(Fitted::nothing(self.aligned.len(), self.control));
        }
        let Started {
            mut trainer,
            options,
            ..
        } = started;
        let (residual, is_whole) = evaluate(trainer.as_mut(), self.aligned, self.control)?;
        let field = trainer.fitted()?;
        Ok(Fitted {
            residual,
            max_iterations: options.max_iterations,
            field: Some(field),
            report: trainer.report(),
            stop_reason: match is_whole {
                true => stop_reason,
                false => StopReason::Deadline,
            },
            precomputed_at,
        })
    }

    /// Whether a deadline that was known before ended the fit of a linear model after so few
    /// iterations that no flow is better. That of a network is not started in this case.
    fn is_worse_than_none(&self, started: &Started<'_>) -> bool {
        if started.throughput.is_none() {
            return false;
        }
        let limits = DeadlineLimits::new(self.ego.is_some());
        let least = limits.least_iterations.min(self.options.max_iterations);
        self.options.network().is_none() && started.trainer.report().iterations < least
    }

    /// The trainer before its first iteration; none if the time left allows no useful fit.
    fn start(&self, state: Option<TrainerState>) -> Result<Option<Started<'_>>, FitError> {
        let (prepared, control) = (self.prepared, self.control);
        let mut options = self.with_margin()?;
        let warm = warm_start(
            self.backend,
            prepared,
            self.aligned,
            self.ego,
            self.prior,
            &mut options,
        )?;
        let start = |options: &FieldOptions| {
            let target = &prepared.target;
            target.start(self.aligned, options, self.seed)
        };
        let mut trainer = start(&options)?;
        let mut cut = !prepared.whole;
        let throughput = match control.seconds_left() {
            None => None,
            Some(_) => Some(Throughput::measure(
                trainer.as_mut(),
                self.aligned,
                control,
            )?),
        };
        let (points, has_ego) = (self.aligned.len(), self.ego.is_some());
        if let Some(state) = state {
            trainer.restore(state)?;
        } else if let (Some(throughput), Some(left)) = (throughput, control.seconds_left())
            && let Some(shortened) =
                throughput.under_deadline(&options, prepared, has_ego, points, left)
        {
            if shortened.max_iterations == 0 {
                return Ok(None);
            }
            cut = true;
            options = shortened;
            // A device may have room for only one trainer.
            drop(trainer);
            trainer = start(&options)?;
            if let Some(warm) = warm {
                trainer.restore(warm)?;
            }
        } else if let Some(warm) = warm {
            trainer.restore(warm)?;
        }
        Ok(Some(Started {
            trainer,
            options,
            throughput,
            cut,
        }))
    }

    /// Iterates until a stopping criterion.
    fn iterate(&self, started: &mut Started<'_>) -> Result<StopReason, FitError> {
        let Started {
            trainer,
            options,
            throughput,
            cut,
        } = started;
        let control = self.control;
        let clock = Loop::begin(control, *throughput, trainer.report().iterations);
        loop {
            let done = trainer.report().iterations;
            if let Some(fitting) = clock.shortened(done, options) {
                *cut = true;
                options.max_iterations = fitting;
                trainer.shorten(fitting);
            }
            let (steps, early) = clock.next(done, STEPS_AT_ONCE);
            match trainer.advance(steps, &early)? {
                Advance::Continues if !*cut && control.snapshot_due() => {
                    if let Some(state) = trainer.state()? {
                        let snapshot = Snapshot::new((self.identity)(), state);
                        control.snapshot(snapshot.to_bytes());
                    }
                }
                Advance::Continues => {}
                Advance::Converged | Advance::Exhausted if *cut => return Ok(StopReason::Deadline),
                Advance::Converged => return Ok(StopReason::Converged),
                Advance::Exhausted => return Ok(StopReason::MaxIterations),
                Advance::Interrupted(Interrupt::Deadline) => return Ok(StopReason::Deadline),
                Advance::Interrupted(Interrupt::Cancelled) => return Err(FitError::Cancelled),
                Advance::Diverged => {
                    return Err(FitError::Diverged {
                        iteration: trainer.report().iterations,
                    });
                }
            }
        }
    }

    /// The options, with `margin_slope` raised to the configured quantile of distance over range.
    fn with_margin(&self) -> Result<FieldOptions, FitError> {
        let mut options = self.options.clone();
        if let Some(loss) = options.loss.distance_mut()
            && let (Some(share), Some(_)) = (loss.margin_quantile, self.ego)
        {
            let distances = self.prepared.target.distances(self.aligned)?;
            let ranges = self.aligned.iter().map(|&point| length(point).max(1.0));
            let slopes = distances
                .iter()
                .zip(ranges)
                .map(|(d, range)| d / range)
                .collect();
            loss.margin_slope = loss.margin_slope.max(quantile(slopes, share));
        }
        Ok(options)
    }
}

/// The value below which `share` of the values lie; zero if there are none.
fn quantile(mut values: Vec<f32>, share: f32) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let index = (share.clamp(0.0, 1.0) * (values.len() - 1) as f32) as usize;
    *values.select_nth_unstable_by(index, f32::total_cmp).1
}
