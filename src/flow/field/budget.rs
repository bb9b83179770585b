//! How work is cut so that a deadline holds: coarser cells, cheaper iterations, fewer of them.
//!
//! A transform of four times coarser cells takes a thirtieth of the time. It is built first: it
//! shows how fast the machine is, and it is there should nothing finer fit. Later the network's
//! speed is measured on some points, and what is left is cut into as many iterations as fit, with
//! the final evaluation set aside. Sees only the backend's traits.

use super::backend::{Backend, BackendError, Trainer, Transform};
use super::snapshot::Snapshot;
use crate::flow::data::{Control, Interrupt, Point, Progress, RigidTransform, stride_sample};
use crate::flow::error::FlowError;
use crate::flow::options::{DeadlineLimits, Ego, LearningRateSchedule, Options};
use crate::flow::select::Selection;

/// Time left from which nothing is measured before the transform, seconds a point of both clouds:
/// twenty times what a slow core takes for the transform.
const AMPLE_SECONDS_PER_POINT: f64 = 4e-5;
/// The first transform's cells, in cells of the options.
const COARSE: f64 = 4.0;
/// Finer cells, best first, and what their transform takes in times of the first one: 20 to 35 and
/// 3.6 to 4.5, measured on three sweeps. Wrong guesses cost accuracy, not the deadline.
const FINER: [(f64, f64); 2] = [(1.0, 28.0), (2.0, 4.5)];
/// Share of the time left that a finer transform may be expected to take.
const EXPECTED_SHARE: f64 = 0.4;
/// Share of the time left after which a finer transform is given up.
const GIVEN_UP_SHARE: f64 = 0.6;
/// Points of each cloud that are aligned where time is short: a millimetre is not to be had then.
const ALIGNED: usize = 8192;
/// Time left from which all points are aligned where nothing else shows how fast the machine is,
/// seconds a point: four times what a slow core takes.
const ALIGNMENT_SECONDS_PER_POINT: f64 = 2e-6;
/// Time left from which a sweep around the pair is looked at, seconds a point of it and the target:
/// it is the first to be done without.
const AROUND_SECONDS_PER_POINT: f64 = 2e-5;
/// Points on which the network's speed is measured: about a millisecond, whole tiles.
const MEASURED: usize = 1536;
/// Less than this is what it takes to ask a device anything, seconds: then more points are measured.
const LATENCY: f64 = 4e-4;
/// As many.
const MEASURED_WHERE_FAST: usize = 16 * MEASURED;
/// What an iteration costs a point, in evaluations: forward, twice that backward, and the query.
const ITERATION: f64 = 3.4;
/// Where the step size falls, a run that is predicted to take this many times too long is begun
/// all the same: the prediction is rough, and it can be shortened.
const ROUGH: f64 = 1.35;
/// What is set aside for the final evaluation, in times of what it should take.
const EVALUATION: f64 = 1.15;
/// Set aside for what nobody measures, seconds.
const SLACK: f64 = 0.006;
/// Rows that are evaluated between two looks at the clock.
const ROWS_AT_ONCE: usize = 9216;
/// A run is shortened where less than this share of its iterations fits.
const FITTING_SHARE: f64 = 0.95;
/// Share of the time left that may pass without a look at the clock, on devices that do several
/// iterations at once.
const STEPS_SHARE: f64 = 0.05;
/// Iterations between two such checks.
const ITERATIONS_AT_ONCE: usize = 8;

/// A watch whose deadline comes earlier.
pub(crate) struct EarlierDeadline<'a> {
    control: &'a dyn Control,
    /// Seconds by which it does.
    reserve: f64,
}

impl Control for EarlierDeadline<'_> {
    fn seconds(&self) -> f64 {
        self.control.seconds()
    }
    fn seconds_left(&self) -> Option<f64> {
        self.control.seconds_left().map(|left| left - self.reserve)
    }
    fn interrupt(&self) -> Option<Interrupt> {
        let late = || self.seconds_left().is_some_and(|left| left <= 0.0);
        let interrupt = self.control.interrupt();
        interrupt.or_else(|| late().then_some(Interrupt::Deadline))
    }
    fn progress(&self, progress: Progress) {
        self.control.progress(progress);
    }
    fn snapshot_due(&self) -> bool {
        self.control.snapshot_due()
    }
    fn snapshot(&self, snapshot: Snapshot) {
        self.control.snapshot(snapshot);
    }
}

/// What the field is fitted to.
pub(crate) struct Prepared {
    pub(crate) transform: Box<dyn Transform>,
    pub(crate) ego: Option<RigidTransform>,
    /// Whether it is all that the options ask for.
    pub(crate) whole: bool,
}

/// The finest transform that the time left holds, and the ego motion, sought about `prior`; none
/// where the deadline leaves no time for any.
pub(crate) fn prepare(
    backend: &dyn Backend,
    selection: &Selection,
    options: &Options,
    prior: &RigidTransform,
    control: &dyn Control,
) -> Result<Option<Prepared>, FlowError> {
    let on_time = EarlierDeadline {
        control,
        reserve: 0.0,
    };
    let transform = |coarser: f64, control: &dyn Control| {
        let mut distance = options.distance.clone();
        distance.cell_m *= coarser;
        distance.band_m = distance.band_m.max(distance.cell_m);
        match backend.transform(&selection.source, &selection.target, &distance, control) {
            Ok(transform) => Ok(Some(transform)),
            Err(BackendError::Interrupted(Interrupt::Deadline)) => Ok(None),
            Err(BackendError::Interrupted(Interrupt::Cancelled)) => Err(FlowError::Cancelled),
            Err(error) => Err(error.into()),
        }
    };
    let aligned = |transform: Box<dyn Transform>, whole: bool| Prepared {
        transform,
        ego: ego(backend, selection, options, prior, whole, &on_time),
        whole,
    };
    let points = selection.source.len() + selection.target.len();
    let ample = AMPLE_SECONDS_PER_POINT * points as f64;
    if control.seconds_left().is_none_or(|left| left > ample) {
        let transform = transform(1.0, &on_time)?;
        return Ok(transform.map(|transform| aligned(transform, true)));
    }
    let began = control.seconds();
    let Some(coarse) = transform(COARSE, &on_time)? else {
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
        match transform(coarser, &early)? {
            Some(transform) => return Ok(Some(aligned(transform, coarser == 1.0))),
            None => break,
        }
    }
    Ok(Some(aligned(coarse, false)))
}

/// The ego motion where there is no transform: given, or, where nothing but it is needed, found from
/// as many points as the time left holds.
pub(crate) fn ego_alone(
    backend: &dyn Backend,
    selection: &Selection,
    options: &Options,
    prior: &RigidTransform,
    control: &dyn Control,
) -> Option<RigidTransform> {
    if options.label.is_none() {
        return match options.ego {
            Ego::Given(target_from_source) => Some(target_from_source),
            Ego::Auto | Ego::Off => None,
        };
    }
    let points: usize = selection
        .registration_clouds
        .iter()
        .flatten()
        .map(Vec::len)
        .sum();
    let ample = ALIGNMENT_SECONDS_PER_POINT * points as f64;
    let whole = control.seconds_left().is_none_or(|left| left > ample);
    let on_time = EarlierDeadline {
        control,
        reserve: 0.0,
    };
    ego(backend, selection, options, prior, whole, &on_time)
}

/// Whether the time left holds a sweep around the pair: `points` to be aligned, and to be searched.
pub(crate) fn has_time_around(points: usize, control: &dyn Control) -> bool {
    let needed = AROUND_SECONDS_PER_POINT * points as f64;
    control.interrupt().is_none() && control.seconds_left().is_none_or(|left| left > needed)
}

/// The ego motion that the options ask for, from the whole clouds or some of their points.
fn ego(
    backend: &dyn Backend,
    selection: &Selection,
    options: &Options,
    prior: &RigidTransform,
    whole: bool,
    control: &dyn Control,
) -> Option<RigidTransform> {
    let align =
        |[source, target]: [&[Point]; 2]| backend.host().align(source, target, prior, control);
    match (options.ego, &selection.registration_clouds) {
        (Ego::Given(target_from_source), _) => Some(target_from_source),
        (Ego::Auto, Some([source, target])) if whole => Some(align([source, target])),
        (Ego::Auto, Some(clouds)) => {
            let [source, target] = clouds
                .each_ref()
                .map(|points| stride_sample(points, ALIGNED));
            Some(align([&source, &target]))
        }
        (Ego::Off, _) | (Ego::Auto, None) => None,
    }
}

/// How fast the network is, and what of the time is spoken for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Throughput {
    /// Seconds that an evaluation takes a point.
    point: f64,
    /// Seconds for the final evaluation and all that follows.
    evaluation: f64,
}

impl Throughput {
    /// Measures on some of the points; the second time, for the first warms up.
    pub(crate) fn measure(
        trainer: &mut dyn Trainer,
        points: &[Point],
        control: &dyn Control,
    ) -> Result<Self, FlowError> {
        let first = |count: usize| &points[..points.len().min(count)];
        let mut seconds = |points: &[Point]| -> Result<f64, FlowError> {
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

    /// The options that fit into `left` seconds; nothing where those that were asked for fit.
    pub(crate) fn under_deadline(
        &self,
        options: &Options,
        prepared: &Prepared,
        points: usize,
        left: f64,
    ) -> Option<Options> {
        let budget = (left - self.evaluation).max(0.0);
        let iteration = |batch: usize| self.point * ITERATION * batch as f64;
        let asked = options.batch.unwrap_or(points).min(points);
        let needed = options.expected_iterations() as f64 * iteration(asked);
        let tolerance = match options.decay {
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
        } = DeadlineLimits::new(prepared.ego.is_some());
        let wished = iterations.min(options.max_iterations) as f64;
        let fitting = budget / (wished * iteration(1));
        let batch = (fitting as usize / least * least).clamp(least, most.max(least));
        let batch = batch.min(asked);
        // Never more work than was asked for, in more steps.
        let most = options.max_iterations.saturating_mul(asked) / batch;
        let fitting = ((budget / iteration(batch)) as usize).min(most);
        let enough = fitting >= least_iterations.min(options.max_iterations);
        Some(options.under_deadline(batch, if enough { fitting } else { 0 }))
    }
}

/// The loop's clock: when to stop iterating, and how many more iterations fit.
pub(crate) struct Loop<'a> {
    control: &'a dyn Control,
    throughput: Option<Throughput>,
    began: f64,
    first: usize,
}

impl<'a> Loop<'a> {
    /// Begins after `first` iterations; without a pace there is no deadline to keep.
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

    /// Iterations that may be done at once, of `steps`, and the watch over them: it ends them while
    /// there is time for one iteration and the evaluation.
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
                // As many as up to the next check of what fits.
                (fitting as usize).clamp(1, ITERATIONS_AT_ONCE - since % ITERATIONS_AT_ONCE)
            }
            _ if self.throughput.is_some() => 1,
            _ => steps,
        };
        (steps, early)
    }

    /// Where the step size falls and the iterations up to the end do not fit: how many do.
    pub(crate) fn shortened(&self, done: usize, options: &Options) -> Option<usize> {
        let throughput = self.throughput?;
        let since = done - self.first;
        if options.decay != LearningRateSchedule::Cosine
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

    /// Seconds of one iteration: the mean so far.
    fn iteration(&self, done: usize) -> f64 {
        (self.control.seconds() - self.began) / (done - self.first).max(1) as f64
    }
}

/// The result so far at `points`; zero from where the deadline passes.
pub(crate) fn evaluate(
    trainer: &mut dyn Trainer,
    points: &[Point],
    control: &dyn Control,
) -> Result<Vec<Point>, FlowError> {
    if control.seconds_left().is_none() {
        return Ok(trainer.evaluate(points)?);
    }
    let mut flow = Vec::with_capacity(points.len());
    for rows in points.chunks(ROWS_AT_ONCE) {
        if control.seconds_left().is_some_and(|left| left <= 0.0) {
            break;
        }
        flow.extend(trainer.evaluate(rows)?);
    }
    flow.resize(points.len(), [0.0; 3]);
    Ok(flow)
}
