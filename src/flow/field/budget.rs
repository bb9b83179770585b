//! Adapts a fit to its deadline: coarser cells, cheaper iterations, or fewer of them.
//!
//! With four times coarser cells, a distance transform takes a thirtieth of the time. Under a tight
//! deadline it is built first. It measures the machine's speed, and it is the fallback if no finer
//! transform fits. Then the network's speed is measured on some points. The remaining time, less a
//! reserve for the final evaluation, determines the batch size and the number of iterations.

use super::backend::{Backend, BackendError, PreparedTarget, Trainer};
use super::chamfer::chamfer_work;
use super::error::FitError;
use super::mlp::PARAMETERS;
use crate::flow::data::{Control, EarlierDeadline, Interrupt, Point};
use crate::flow::options::{DeadlineLimits, FieldOptions, LearningRateSchedule, LossOptions};

/// With more time left than this, the requested transform is built directly, seconds per point of
/// both clouds: twenty times the time of the transform on a slow core.
const AMPLE_SECONDS_PER_POINT: f64 = 4e-5;
/// Cells of the first transform, relative to those of the options.
const COARSE: f64 = 4.0;
/// Finer cells, best first, and the time of their transform relative to the first one: 20 to 35 and
/// 3.6 to 4.5, measured on three sweeps. Wrong values cost accuracy, not the deadline.
const FINER: [(f64, f64); 2] = [(1.0, 28.0), (2.0, 4.5)];
/// A finer transform is tried only if it is expected to take at most this share of the time left.
const EXPECTED_SHARE: f64 = 0.4;
/// A finer transform is abandoned after this share of the time left.
const GIVEN_UP_SHARE: f64 = 0.6;
/// Points on which the network's speed is measured: about a millisecond, and a whole number of
/// tiles.
const MEASURED: usize = 1536;
/// A shorter measurement is dominated by the device's latency, seconds; more points are then
/// measured.
const LATENCY: f64 = 4e-4;
/// Number of points of that second measurement.
const MEASURED_WHERE_FAST: usize = 16 * MEASURED;
/// Cost of an iteration without its loss, relative to an evaluation, per point: forward pass, and
/// twice that for the backward pass.
const ITERATION: f64 = 3.0;
/// Cost of a distance query, relative to an evaluation, per point.
const DISTANCE_QUERY: f64 = 0.4;
/// With a cosine schedule, a fit that is predicted to take up to this many times the available time
/// is started unchanged. The prediction is rough, and the fit can be shortened later.
const ROUGH: f64 = 1.35;
/// Reserve for the final evaluation, relative to its predicted time.
const EVALUATION: f64 = 1.15;
/// Reserve for unmeasured work, seconds.
const SLACK: f64 = 0.006;
/// Points that are evaluated between two checks of the time left.
const ROWS_AT_ONCE: usize = 9216;
/// A fit is shortened if less than this share of its remaining iterations fits.
const FITTING_SHARE: f64 = 0.95;
/// Share of the time left that may pass without a check, on devices that do several iterations at
/// once.
const STEPS_SHARE: f64 = 0.05;
/// Iterations between two checks of whether the remaining ones fit.
const ITERATIONS_AT_ONCE: usize = 8;

/// A prepared target, with the finest distance transform that the time allows.
pub(crate) struct Prepared {
    pub(crate) target: Box<dyn PreparedTarget>,
    /// Whether its transform has the cells of the options; true without a transform.
    pub(crate) whole: bool,
    target_points: usize,
}

/// Prepares `target` for the loss of `options`. A distance transform is the finest one that fits in
/// the time left, over a grid that covers both clouds; none if there is no time for any.
///
/// # Errors
/// [`FitError`] if the clouds are refused, the control cancels or the device fails.
pub(crate) fn prepare_target(
    backend: &dyn Backend,
    [source, target]: [&[Point]; 2],
    options: &FieldOptions,
    control: &dyn Control,
) -> Result<Option<Prepared>, FitError> {
    let on_time = EarlierDeadline {
        control,
        reserve: 0.0,
    };
    let prepare = |coarser: f64, control: &dyn Control| {
        let mut loss = options.loss.clone();
        if let Some(loss) = loss.distance_mut() {
            loss.transform.set_cell(loss.transform.cell_m * coarser);
        }
        let prepared = backend.prepare_target(source, target, &loss, control);
        let prepared = prepared.and_then(|mut target| {
            if options.has_cycle() {
                target.prepare_cycle(source, control)?;
            }
            Ok(target)
        });
        match prepared {
            Ok(target) => Ok(Some(target)),
            Err(BackendError::Interrupted(Interrupt::Deadline)) => Ok(None),
            Err(BackendError::Interrupted(Interrupt::Cancelled)) => Err(FitError::Cancelled),
            Err(error) => Err(error.into()),
        }
    };
    let prepared = |whole: bool| {
        move |prepared: Box<dyn PreparedTarget>| Prepared {
            target: prepared,
            whole,
            target_points: target.len(),
        }
    };
    let ample = AMPLE_SECONDS_PER_POINT * (source.len() + target.len()) as f64;
    let ample = control.seconds_left().is_none_or(|left| left > ample);
    if ample || options.loss.distance().is_none() {
        return Ok(prepare(1.0, &on_time)?.map(prepared(true)));
    }
    let began = control.seconds();
    let Some(coarse) = prepare(COARSE, &on_time)? else {
        return Ok(None);
    };
    let took = control.seconds() - began;
    for (coarser, cost) in FINER {
        let left = on_time.seconds_left().unwrap_or(0.0);
        if took * cost > left * EXPECTED_SHARE {
            continue;
        }
        let early = EarlierDeadline {
            control,
            reserve: left * (1.0 - GIVEN_UP_SHARE),
        };
        match prepare(coarser, &early) {
            Ok(Some(target)) => return Ok(Some(prepared(coarser == 1.0)(target))),
            Ok(None) => break,
            // Coarser cells take less memory.
            Err(FitError::Backend(error)) if error.is_out_of_memory() => {}
            Err(error) => return Err(error),
        }
    }
    Ok(Some(prepared(false)(coarse)))
}

/// Cost of the loss of `batch` source points and its derivative, in evaluations of the network at
/// one point.
fn loss_cost(loss: &LossOptions, batch: usize, target_points: usize) -> f64 {
    match loss {
        LossOptions::Distance(_) => DISTANCE_QUERY * batch as f64,
        // The flow is computed once more, for the correspondences.
        LossOptions::Chamfer(options) => {
            let work = chamfer_work(options.search, batch, target_points);
            batch as f64 + work / PARAMETERS as f64
        }
    }
}

/// The measured speed of the network, and the time reserved for the final evaluation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Throughput {
    /// Seconds per point of an evaluation.
    point: f64,
    /// Seconds reserved for the final evaluation and all later work.
    evaluation: f64,
}

impl Throughput {
    /// Evaluates some of the points twice and times the second run; the first one is a warm-up.
    pub(crate) fn measure(
        trainer: &mut dyn Trainer,
        points: &[Point],
        control: &dyn Control,
    ) -> Result<Self, FitError> {
        let first = |count: usize| &points[..points.len().min(count)];
        let mut seconds = |points: &[Point]| -> Result<f64, FitError> {
            let began = control.seconds();
            trainer.evaluate(points)?;
            Ok(control.seconds() - began)
        };
        let mut measured = first(MEASURED);
        seconds(measured)?;
        let mut took = seconds(measured)?;
        if took < LATENCY {
            measured = first(MEASURED_WHERE_FAST);
            took = seconds(measured)?;
        }
        let point = took / measured.len() as f64;
        Ok(Self {
            point,
            evaluation: point * points.len() as f64 * EVALUATION + SLACK,
        })
    }

    /// Options that fit in `left` seconds; none if the requested options fit. With `max_iterations`
    /// 0 there is no time for a useful number of iterations.
    pub(crate) fn under_deadline(
        &self,
        options: &FieldOptions,
        prepared: &Prepared,
        has_ego: bool,
        points: usize,
        left: f64,
    ) -> Option<FieldOptions> {
        // The speed of the linear model does not follow from that of its evaluation. It stops in
        // time at any iteration.
        if options.network().is_none() && prepared.whole {
            return None;
        }
        let budget = (left - self.evaluation).max(0.0);
        let networks = if options.has_cycle() { 2.0 } else { 1.0 };
        let iteration = |batch: usize| {
            let loss = loss_cost(&options.loss, batch, prepared.target_points);
            networks * self.point * (ITERATION * batch as f64 + loss)
        };
        let asked = options.batch.unwrap_or(points).clamp(1, points.max(1));
        let needed = options.expected_iterations() as f64 * iteration(asked);
        let tolerance = match options.learning_rate_schedule {
            LearningRateSchedule::Cosine => ROUGH,
            LearningRateSchedule::Constant => 1.0,
        };
        if prepared.whole && needed <= budget * tolerance {
            return None;
        }
        let DeadlineLimits {
            batches: [least, most],
            iterations,
            least_iterations,
        } = DeadlineLimits::new(has_ego);
        let wished = iterations.min(options.max_iterations) as f64;
        let batch = match options.loss {
            LossOptions::Distance(_) => {
                let fitting = budget / (wished * iteration(1));
                let batch = (fitting as usize / least * least).clamp(least, most.max(least));
                batch.min(asked)
            }
            // Target points have no counterparts in a small batch.
            LossOptions::Chamfer(_) => asked,
        };
        // Never more work than requested, even if it is divided into more iterations.
        let most = options.max_iterations.saturating_mul(asked) / batch;
        let fitting = ((budget / iteration(batch)) as usize).min(most);
        let enough = fitting >= least_iterations.min(options.max_iterations);
        Some(options.under_deadline(batch, if enough { fitting } else { 0 }))
    }
}

/// Time control of the iterations: when to stop, and how many more fit.
pub(crate) struct Loop<'a> {
    control: &'a dyn Control,
    throughput: Option<Throughput>,
    began: f64,
    first: usize,
}

impl<'a> Loop<'a> {
    /// Starts the clock after `first` iterations. Without a throughput there is no deadline to
    /// keep.
    pub(crate) fn begin(
        control: &'a dyn Control,
        throughput: Option<Throughput>,
        first: usize,
    ) -> Self {
        Self {
            control,
            throughput,
            began: control.seconds(),
            first,
        }
    }

    /// How many of `steps` iterations may be done at once, and their control. Its deadline leaves
    /// time for one more iteration and the final evaluation.
    pub(crate) fn next(&self, done: usize, steps: usize) -> (usize, EarlierDeadline<'a>) {
        let reserve = self.throughput.map_or(0.0, |throughput| {
            throughput.evaluation + self.iteration(done)
        });
        let early = EarlierDeadline {
            control: self.control,
            reserve,
        };
        let since = done - self.first;
        let steps = match self.control.seconds_left() {
            Some(left) if self.throughput.is_some() && since > 0 => {
                let fitting = STEPS_SHARE * (left - reserve) / self.iteration(done).max(1e-9);
                // At most up to the next check of the remaining iterations.
                (fitting as usize).clamp(1, ITERATIONS_AT_ONCE - since % ITERATIONS_AT_ONCE)
            }
            _ if self.throughput.is_some() => 1,
            _ => steps,
        };
        (steps, early)
    }

    /// With a cosine schedule, the maximum number of iterations that fits; none if the planned ones
    /// fit or no check is due.
    pub(crate) fn shortened(&self, done: usize, options: &FieldOptions) -> Option<usize> {
        let throughput = self.throughput?;
        let since = done - self.first;
        if options.learning_rate_schedule != LearningRateSchedule::Cosine
            || since == 0
            || !since.is_multiple_of(ITERATIONS_AT_ONCE)
        {
            return None;
        }
        let left = self.control.seconds_left()? - throughput.evaluation;
        let fitting = (left / self.iteration(done)).max(0.0);
        let wanted = options.max_iterations.saturating_sub(done) as f64;
        (fitting < FITTING_SHARE * wanted).then_some(done + fitting as usize)
    }

    /// Mean seconds per iteration so far.
    fn iteration(&self, done: usize) -> f64 {
        (self.control.seconds() - self.began) / (done - self.first).max(1) as f64
    }
}

/// The flow of the result so far at `points`, metres, and whether the time sufficed for all of them. It is
/// zero for the points after the deadline.
pub(crate) fn evaluate(
    trainer: &mut dyn Trainer,
    points: &[Point],
    control: &dyn Control,
) -> Result<(Vec<Point>, bool), FitError> {
    if control.seconds_left().is_none() {
        return Ok((trainer.evaluate(points)?, true));
    }
    let mut flow = Vec::with_capacity(points.len());
    for rows in points.chunks(ROWS_AT_ONCE) {
        if control.seconds_left().is_some_and(|left| left <= 0.0) {
            break;
        }
        flow.extend(trainer.evaluate(rows)?);
    }
    let is_whole = flow.len() == points.len();
    flow.resize(points.len(), [0.0; 3]);
    Ok((flow, is_whole))
}
