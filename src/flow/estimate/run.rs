//! TODO doc

use crate::flow::data::{
    Control, DYNAMIC_M, Interrupt, Point, RigidTransform, transform_point, transform_points,
};
use crate::flow::error::FlowError;
use crate::flow::field::{
    Advance, Backend, BackendError, FitReport, Loop, Network, Prepared, Snapshot, Throughput,
    TrainerState, budget, length, warm_start,
};
use crate::flow::motion::{MotionField, Residual};
use crate::flow::objects::{ObjectSearch, Objects, SearchClouds, confidence_of_ground};
use crate::flow::options::{Ego, Options, Precision};
use crate::flow::registration::neighbors;
use crate::flow::select;
use crate::flow::select::{Problem, Selection};

/// Iterations that a backend may do without coming back.
const STEPS_AT_ONCE: usize = 64;

/// The motion of every point.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// N displacements, metres over the gap between the sweeps, ego motion included; zero where
    /// `valid` is false.
    pub flow: Vec<Point>,
    /// N flags: which points have a flow.
    pub valid: Vec<bool>,
    /// N flags, where the ego motion is known: which points move at least [`DYNAMIC_M`] against
    /// the static world.
    pub dynamic: Option<Vec<bool>>,
    /// What the points are parts of and how sure their motion is, where movers are found object by
    /// object.
    pub objects: Option<Objects>,
    /// The ego motion as target_from_source, where it was given or estimated.
    pub ego: Option<RigidTransform>,
    /// Points that took part and have a flow.
    pub points: usize,
    /// Iterations at most, of the run as it was in the end; all clusters where movers are found
    /// object by object.
    pub max_iterations: usize,
    /// Iterations done; clusters looked at where movers are found object by object.
    pub iterations: usize,
    /// The iteration whose field is the result.
    pub best_iteration: usize,
    /// The loss of the result, metres; comparable within one preset and pair.
    pub best_loss: f64,
    /// Why it ended.
    pub stop_reason: StopReason,
    /// What found it, as reports show it: the device that fitted a field, or the host's threads
    /// where movers are found object by object.
    pub device: String,
    /// What it took.
    pub seconds: PhaseSeconds,
    /// Bytes of the distance transform.
    pub distance_bytes: usize,
    /// The motion everywhere, not at the source's points alone.
    pub field: MotionField,
}

/// Why an optimization ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopReason {
    /// The loss stopped falling.
    Converged,
    /// All iterations were done.
    MaxIterations,
    /// Time was up; the flow is the best so far.
    Deadline,
}

impl StopReason {
    /// The name that reports use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Converged => "converged",
            Self::MaxIterations => "max_iterations",
            Self::Deadline => "deadline",
        }
    }
}

/// Seconds by phase, by the watch's clock; the paper's own breakdown.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhaseSeconds {
    /// Selection, distance transform and ego motion.
    pub precompute: f64,
    /// Distance queries.
    pub query: f64,
    /// Network, optimizer and the final evaluation; the search, where movers are found object by
    /// object.
    pub network: f64,
    /// All of it.
    pub total: f64,
}

/// Estimates the motion of every source point.
///
/// # Errors
/// [`FlowError`] where the input is refused, the watch cancels or the device fails. A deadline is
/// no error: the best flow that the time allows comes back.
pub fn estimate(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    solve(backend, problem, options, None, control)
}

/// Goes on where `snapshot` was taken, and ends as [`estimate`] would have, bit for bit.
///
/// # Errors
/// As [`estimate`], and [`FlowError::Snapshot`] where the snapshot belongs to something else.
pub fn resume(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    snapshot: Snapshot,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    solve(backend, problem, options, Some(snapshot), control)
}

fn solve(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    snapshot: Option<Snapshot>,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    let began = control.seconds();
    let find_ground = |sweeps: &[&[Point]]| backend.host().ground(sweeps);
    let selection = select::select(problem, options, &find_ground)?;
    // Without a warm start pairs are independent: of each other, and of the order they are done in.
    let before = problem.before.filter(|_| options.warm_start.is_some());
    let prior = before.and_then(|field| field.ego).unwrap_or_default();
    let state = snapshot
        .map(|snapshot| snapshot.state_for(&selection, options, before))
        .transpose()?;
    let prepared = match &options.label {
        None => budget::prepare(backend, &selection, options, &prior, control)?,
        Some(_) => None,
    };
    let ego = match &prepared {
        Some(prepared) => prepared.ego,
        None => budget::ego_alone(backend, &selection, options, &prior, control),
    };
    let aligned = match &ego {
        None => selection.source.clone(),
        Some(motion) => transform_points(motion, &selection.source),
    };
    if control.interrupt() == Some(Interrupt::Cancelled) {
        return Err(FlowError::Cancelled);
    }
    let mut objects = None;
    let fitted = match (&options.label, &prepared) {
        (Some(_), _) if options.precision != Precision::F32 => {
            let text = "objects are found in single precision alone: take preset neural";
            return Err(BackendError::Unsupported(text).into());
        }
        (Some(label), _) => {
            let around = match &ego {
                Some(ego) => {
                    neighbors::aligned(backend, problem, options, ego, label.frames, control)?
                }
                None => Vec::new(),
            };
            let precomputed = control.seconds();
            let clouds = SearchClouds {
                source: &aligned,
                target: &selection.target,
                around: &around,
                sweeps: [problem.source, problem.target],
                target_from_source: ego.unwrap_or_default(),
            };
            let labelled = backend.host().find_objects(&clouds, label, control);
            backend.host().threads().install(|| {
                objects = Some(Objects::new(
                    problem.source.len(),
                    &selection.rows,
                    &selection.source,
                    &labelled,
                    &ego.unwrap_or_default(),
                ));
                Fitted::of_movers(labelled, &aligned, precomputed)
            })?
        }
        (None, None) => Fitted::nothing(aligned.len(), control),
        (None, Some(prepared)) => Fit {
            backend,
            before,
            selection: &selection,
            aligned: &aligned,
            asked: options,
            prepared,
            control,
        }
        .run(state)?,
    };

    let mut flow = vec![[0.0; 3]; problem.source.len()];
    let mut valid = vec![false; problem.source.len()];
    let mut dynamic = ego.map(|_| vec![false; problem.source.len()]);
    for &i in &selection.output_rows {
        let row = selection.rows[i];
        let (from, to, residual) = (selection.source[i], aligned[i], fitted.residual[i]);
        flow[row] = core::array::from_fn(|a| (to[a] - from[a]) + residual[a]);
        valid[row] = true;
        if let Some(dynamic) = &mut dynamic {
            let square: f32 = residual.iter().map(|r| r * r).sum();
            dynamic[row] = square >= DYNAMIC_M * DYNAMIC_M;
        }
    }
    // Where there was no time for an ego motion they stand still, as everything else does.
    if options.ego != Ego::Off {
        let motion = ego.unwrap_or_default();
        for &row in &selection.ego_only_rows {
            let (from, to) = (
                problem.source[row],
                transform_point(&motion, problem.source[row]),
            );
            flow[row] = core::array::from_fn(|a| to[a] - from[a]);
            valid[row] = true;
            if let Some(objects) = &mut objects {
                objects.confidence[row] = confidence_of_ground(to[0].hypot(to[1]));
            }
        }
    }
    if let Some(objects) = &mut objects {
        objects.sure_of(&valid);
    }
    let report = fitted.report;
    let precompute = fitted.precomputed - began;
    let total = control.seconds() - began;
    Ok(Estimate {
        flow,
        valid,
        dynamic,
        objects,
        ego,
        points: selection.output_rows.len(),
        max_iterations: fitted.max_iterations,
        iterations: report.iterations,
        best_iteration: report.best_iteration,
        best_loss: report.best_loss,
        stop_reason: fitted.stop_reason,
        device: match &options.label {
            None => backend.name(),
            Some(_) => backend.host().name().to_owned(),
        },
        seconds: PhaseSeconds {
            precompute,
            query: report.query_seconds,
            network: total - precompute - report.query_seconds,
            total,
        },
        distance_bytes: prepared.map_or(0, |prepared| prepared.transform.bytes()),
        field: MotionField {
            ego,
            residual: fitted.field,
        },
    })
}

/// One fit of a field to what is prepared.
struct Fit<'a> {
    backend: &'a dyn Backend,
    before: Option<&'a MotionField>,
    selection: &'a Selection,
    /// The source, the ego motion taken out.
    aligned: &'a [Point],
    asked: &'a Options,
    prepared: &'a Prepared,
    control: &'a dyn Control,
}

/// A fitted field at the source's points.
struct Fitted {
    residual: Vec<Point>,
    field: Residual,
    report: FitReport,
    max_iterations: usize,
    stop_reason: StopReason,
    /// When the first iteration could begin.
    precomputed: f64,
}

impl Fitted {
    /// No field at all: there was no time.
    fn nothing(points: usize, control: &dyn Control) -> Self {
        Self {
            residual: vec![[0.0; 3]; points],
            field: Residual::Still,
            max_iterations: 0,
            report: FitReport {
                iterations: 0,
                best_iteration: 0,
                best_loss: f64::INFINITY,
                query_seconds: 0.0,
            },
            stop_reason: StopReason::Deadline,
            precomputed: control.seconds(),
        }
    }

    /// The motion of every point of `aligned` that moves with an object.
    fn of_movers(
        labelled: ObjectSearch,
        aligned: &[Point],
        precomputed: f64,
    ) -> Result<Self, FlowError> {
        if labelled.interrupted == Some(Interrupt::Cancelled) {
            return Err(FlowError::Cancelled);
        }
        Ok(Self {
            residual: labelled.residual_of(aligned),
            field: Residual::Objects(labelled.motions.into()),
            max_iterations: labelled.all_clusters,
            report: FitReport {
                iterations: labelled.clusters,
                best_iteration: labelled.clusters,
                best_loss: labelled.cost_m,
                query_seconds: 0.0,
            },
            stop_reason: match labelled.interrupted {
                Some(_) => StopReason::Deadline,
                None => StopReason::MaxIterations,
            },
            precomputed,
        })
    }
}

impl Fit<'_> {
    /// Fits from the start, or from `state`.
    fn run(&self, state: Option<TrainerState>) -> Result<Fitted, FlowError> {
        let (prepared, control) = (self.prepared, self.control);
        let mut options = self.with_margin()?;
        let warm = warm_start(
            self.backend,
            prepared,
            self.aligned,
            self.before,
            &mut options,
        )?;
        let mut trainer = prepared.transform.start(self.aligned, &options)?;
        let mut cut = !prepared.whole;
        let throughput = match control.seconds_left() {
            None => None,
            Some(_) => Some(Throughput::measure(
                trainer.as_mut(),
                self.aligned,
                control,
            )?),
        };
        let left = control.seconds_left();
        if let Some(state) = state {
            trainer.restore(state)?;
        } else if let (Some(throughput), Some(left)) = (throughput, left)
            && let Some(under_deadline) =
                throughput.under_deadline(&options, prepared, self.aligned.len(), left)
        {
            if under_deadline.max_iterations == 0 {
                return Ok(Fitted::nothing(self.aligned.len(), control));
            }
            cut = true;
            options = under_deadline;
            // A device may have room for one only.
            drop(trainer);
            trainer = prepared.transform.start(self.aligned, &options)?;
            if let Some(warm) = warm {
                trainer.restore(warm)?;
            }
        } else if let Some(warm) = warm {
            trainer.restore(warm)?;
        }
        let precomputed = control.seconds();
        let clock = Loop::begin(control, throughput, trainer.report().iterations);
        let stop_reason = loop {
            let done = trainer.report().iterations;
            if let Some(fitting) = clock.shortened(done, &options) {
                cut = true;
                options.max_iterations = fitting;
                trainer.shorten(fitting);
            }
            let (steps, early) = clock.next(done, STEPS_AT_ONCE);
            match trainer.advance(steps, &early)? {
                Advance::Continues if !cut && control.snapshot_due() => {
                    let state = trainer.state()?;
                    control.snapshot(Snapshot::new(
                        self.selection,
                        self.asked,
                        self.before,
                        state,
                    ));
                }
                Advance::Continues => {}
                Advance::Converged | Advance::Exhausted if cut => break StopReason::Deadline,
                Advance::Converged => break StopReason::Converged,
                Advance::Exhausted => break StopReason::MaxIterations,
                Advance::Interrupted(Interrupt::Deadline) => break StopReason::Deadline,
                Advance::Interrupted(Interrupt::Cancelled) => return Err(FlowError::Cancelled),
                Advance::Diverged => {
                    return Err(FlowError::Diverged {
                        iteration: trainer.report().iterations,
                    });
                }
            }
        };
        let residual = budget::evaluate(trainer.as_mut(), self.aligned, control)?;
        let parameters = trainer.state()?.kept;
        Ok(Fitted {
            residual,
            max_iterations: options.max_iterations,
            field: Residual::Network(Network::new(parameters, self.aligned, options.inputs)),
            report: trainer.report(),
            stop_reason,
            precomputed,
        })
    }

    /// The options, with the margin that the pair asks for.
    fn with_margin(&self) -> Result<Options, FlowError> {
        let mut options = self.asked.clone();
        if let (Some(share), Some(_)) = (options.loss.margin_quantile, &self.prepared.ego) {
            let distances = self.prepared.transform.distances(self.aligned)?;
            let ranges = self.aligned.iter().map(|&point| length(point).max(1.0));
            let slopes = distances
                .iter()
                .zip(ranges)
                .map(|(d, range)| d / range)
                .collect();
            options.loss.margin_slope = options.loss.margin_slope.max(quantile(slopes, share));
        }
        Ok(options)
    }
}

/// The value below which `share` of the values lie; zero where there are none.
fn quantile(mut values: Vec<f32>, share: f32) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let place = (share.clamp(0.0, 1.0) * (values.len() - 1) as f32) as usize;
    *values.select_nth_unstable_by(place, f32::total_cmp).1
}
