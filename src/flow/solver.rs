//! The loop: select, transform, align, then forward, query, backward and Adam until the end.
//!
//! FNSF Section 3: `theta* = argmin mean_p D(p + g(p; theta))`. Sees only the backend's traits.
//! What becomes of it under a deadline is in `deadline.rs`.

use super::backend::{Advance, Backend, Report};
use super::deadline::{self, Loop, Pace, Prepared};
use super::error::FlowError;
use super::field::mlp::Conditioning;
use super::field::{Field, Network};
use super::loss::length;
use super::options::{Ego, Options};
use super::points::{Point, RigidTransform, evenly, moved};
use super::preprocess::{self, Problem, Selection};
use super::snapshot::{Snapshot, TrainerState};
use super::watch::{Interrupt, Watch};

/// Iterations that a backend may do without coming back.
const STEPS_AT_ONCE: usize = 64;

/// Points on which a field of the pair before is judged.
const JUDGED: usize = 4096;

/// Residual motion of a frame from which a point counts as moving, metres (Argoverse 2).
pub const DYNAMIC_M: f32 = 0.05;

/// The motion of every point.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// N displacements, metres over the gap between the sweeps, ego motion included; zero where
    /// `valid` is false.
    pub flow: Vec<Point>,
    /// N flags: which points took part.
    pub valid: Vec<bool>,
    /// N flags, where the ego motion is known: which points move at least [`DYNAMIC_M`] against
    /// the static world.
    pub dynamic: Option<Vec<bool>>,
    /// The ego motion as target_from_source, where it was given or estimated.
    pub ego: Option<RigidTransform>,
    /// Points that took part.
    pub points: usize,
    /// Iterations done.
    pub iterations: usize,
    /// The iteration whose field is the result.
    pub best_iteration: usize,
    /// The loss of the result, metres; comparable within one preset and pair.
    pub best_loss: f64,
    /// Why it ended.
    pub stop_reason: StopReason,
    /// What it took.
    pub seconds: PhaseSeconds,
    /// Bytes of the distance transform.
    pub distance_bytes: usize,
    /// The motion everywhere, not at the source's points alone.
    pub field: Field,
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
    /// Network, optimizer and the final evaluation.
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
    watch: &dyn Watch,
) -> Result<Estimate, FlowError> {
    solve(backend, problem, options, None, watch)
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
    watch: &dyn Watch,
) -> Result<Estimate, FlowError> {
    solve(backend, problem, options, Some(snapshot), watch)
}

fn solve(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    snapshot: Option<Snapshot>,
    watch: &dyn Watch,
) -> Result<Estimate, FlowError> {
    let began = watch.seconds();
    let selection = preprocess::select(problem, options)?;
    let state = snapshot
        .map(|snapshot| snapshot.state_for(&selection, options, problem.before))
        .transpose()?;
    let prior = problem.before.and_then(|field| field.ego);
    let prior = prior.unwrap_or_default();
    let prepared = deadline::prepare(backend, &selection, options, &prior, watch)?;
    let ego = match (&prepared, options.ego) {
        (Some(prepared), _) => prepared.ego,
        (None, Ego::Given(target_from_source)) => Some(target_from_source),
        (None, _) => None,
    };
    let aligned = match &ego {
        None => selection.source.clone(),
        Some(motion) => selection
            .source
            .iter()
            .map(|&point| moved(motion, point))
            .collect(),
    };
    if watch.interrupt() == Some(Interrupt::Cancelled) {
        return Err(FlowError::Cancelled);
    }
    let fitted = match &prepared {
        None => Fitted::nothing(aligned.len(), watch),
        Some(prepared) => Fit {
            backend,
            before: problem.before,
            selection: &selection,
            aligned: &aligned,
            asked: options,
            prepared,
            watch,
        }
        .run(state)?,
    };

    let mut flow = vec![[0.0; 3]; problem.source.len()];
    let mut valid = vec![false; problem.source.len()];
    let mut dynamic = ego.map(|_| vec![false; problem.source.len()]);
    for (i, &row) in selection.rows.iter().enumerate() {
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
        for &row in &selection.carried {
            let (from, to) = (problem.source[row], moved(&motion, problem.source[row]));
            flow[row] = core::array::from_fn(|a| to[a] - from[a]);
            valid[row] = true;
        }
    }
    let report = fitted.report;
    let precompute = fitted.precomputed - began;
    let total = watch.seconds() - began;
    Ok(Estimate {
        flow,
        valid,
        dynamic,
        ego,
        points: selection.rows.len(),
        iterations: report.iterations,
        best_iteration: report.best_iteration,
        best_loss: report.best_loss,
        stop_reason: fitted.stop_reason,
        seconds: PhaseSeconds {
            precompute,
            query: report.query_seconds,
            network: total - precompute - report.query_seconds,
            total,
        },
        distance_bytes: prepared.map_or(0, |prepared| prepared.transform.bytes()),
        field: Field {
            ego,
            network: fitted.network,
        },
    })
}

/// One fit of a field to what is prepared.
struct Fit<'a> {
    backend: &'a dyn Backend,
    before: Option<&'a Field>,
    selection: &'a Selection,
    /// The source, the ego motion taken out.
    aligned: &'a [Point],
    asked: &'a Options,
    prepared: &'a Prepared,
    watch: &'a dyn Watch,
}

/// A fitted field at the source's points.
struct Fitted {
    residual: Vec<Point>,
    network: Option<Network>,
    report: Report,
    stop_reason: StopReason,
    /// When the first iteration could begin.
    precomputed: f64,
}

impl Fitted {
    /// No field at all: there was no time.
    fn nothing(points: usize, watch: &dyn Watch) -> Self {
        Self {
            residual: vec![[0.0; 3]; points],
            network: None,
            report: Report {
                iterations: 0,
                best_iteration: 0,
                best_loss: f64::INFINITY,
                query_seconds: 0.0,
            },
            stop_reason: StopReason::Deadline,
            precomputed: watch.seconds(),
        }
    }
}

impl Fit<'_> {
    /// Fits from the start, or from `state`.
    fn run(&self, state: Option<TrainerState>) -> Result<Fitted, FlowError> {
        let (prepared, watch) = (self.prepared, self.watch);
        let mut options = self.with_margin()?;
        let warm = self.warm_start(&mut options)?;
        let mut trainer = prepared.transform.start(self.aligned, &options)?;
        let mut cut = !prepared.whole;
        let pace = match watch.seconds_left() {
            None => None,
            Some(_) => Some(Pace::measure(trainer.as_mut(), self.aligned, watch)?),
        };
        let left = watch.seconds_left();
        if let Some(state) = state {
            trainer.restore(state)?;
        } else if let (Some(pace), Some(left)) = (pace, left)
            && let Some(hurried) = pace.hurried(&options, prepared, self.aligned.len(), left)
        {
            if hurried.max_iterations == 0 {
                return Ok(Fitted::nothing(self.aligned.len(), watch));
            }
            cut = true;
            options = hurried;
            // A device may have room for one only.
            drop(trainer);
            trainer = prepared.transform.start(self.aligned, &options)?;
            if let Some(warm) = warm {
                trainer.restore(warm)?;
            }
        } else if let Some(warm) = warm {
            trainer.restore(warm)?;
        }
        let precomputed = watch.seconds();
        let clock = Loop::begin(watch, pace, trainer.report().iterations);
        let stop_reason = loop {
            let done = trainer.report().iterations;
            if let Some(fitting) = clock.shortened(done, &options) {
                cut = true;
                options.max_iterations = fitting;
                trainer.shorten(fitting);
            }
            let (steps, early) = clock.next(done, STEPS_AT_ONCE);
            match trainer.advance(steps, &early)? {
                Advance::Continues if !cut && watch.snapshot_due() => {
                    let state = trainer.state()?;
                    watch.snapshot(Snapshot::new(
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
        let residual = deadline::evaluate(trainer.as_mut(), self.aligned, watch)?;
        let parameters = trainer.state()?.kept;
        Ok(Fitted {
            residual,
            network: Some(Network::new(parameters, self.aligned, options.inputs)),
            report: trainer.report(),
            stop_reason,
            precomputed,
        })
    }

    /// The state of a fit that starts from the field of the pair before, and its options; none
    /// where there is no such field, or it explains this pair no better than that nothing moves.
    fn warm_start(&self, options: &mut Options) -> Result<Option<TrainerState>, FlowError> {
        let (Some(warm_start), Some(before)) = (options.warm_start, self.before) else {
            return Ok(None);
        };
        let same_kind = before.ego.is_some() == self.prepared.ego.is_some();
        let Some(network) = before.network.as_ref().filter(|_| same_kind) else {
            return Ok(None);
        };
        let conditioning = Conditioning::new(self.aligned, options.inputs);
        let motion = self.prepared.ego.unwrap_or_default();
        let carried = Network {
            parameters: network.carried(&motion, &conditioning),
            conditioning,
        };
        let points = evenly(self.aligned, JUDGED);
        let flows = self.backend.evaluate(&carried, &points)?;
        let [carried_loss, still_loss] = [
            self.mean_loss(options, &points, &flows)?,
            self.mean_loss(options, &points, &vec![[0.0; 3]; points.len()])?,
        ];
        // Not the other way round: a loss that is no number starts afresh.
        if carried_loss < still_loss {
            *options = options.warmed(warm_start);
            return Ok(Some(TrainerState::at_start(carried.parameters)));
        }
        Ok(None)
    }

    /// The mean loss of `points` moved by `flows`.
    fn mean_loss(
        &self,
        options: &Options,
        points: &[Point],
        flows: &[Point],
    ) -> Result<f64, FlowError> {
        let pairs = || points.iter().zip(flows);
        let moved = pairs().map(|(point, flow)| core::array::from_fn(|a| point[a] + flow[a]));
        let distances = self
            .prepared
            .transform
            .distances(&moved.collect::<Vec<_>>())?;
        let losses = pairs().zip(distances).map(|((&point, &flow), distance)| {
            f64::from(options.loss.value(point, distance, flow))
        });
        Ok(losses.sum::<f64>() / points.len() as f64)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::cpu::CpuBackend;
    use crate::flow::options::{Ground, Preset};
    use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};
    use crate::flow::watch::{Progress, Unwatched};
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// Interrupts after a number of iterations.
    struct After(usize, Interrupt, AtomicUsize);

    impl Watch for After {
        fn interrupt(&self) -> Option<Interrupt> {
            (self.2.load(Ordering::Relaxed) >= self.0).then_some(self.1)
        }
        fn progress(&self, progress: Progress) {
            self.2.store(progress.iteration, Ordering::Relaxed);
        }
    }

    fn street() -> SimulatedPair {
        let options = StreetOptions {
            beams: 16,
            azimuth_steps: 500,
            ..StreetOptions::default()
        };
        Street::new(&options)
            .and_then(|street| street.pair(0))
            .expect("a small street")
    }

    fn solve(
        pair: &SimulatedPair,
        options: &Options,
        watch: &dyn Watch,
    ) -> Result<Estimate, FlowError> {
        let backend = CpuBackend::new(Some(2)).expect("threads");
        let problem = Problem {
            source: &pair.source,
            target: &pair.target,
            ground: Some([&pair.ground_source, &pair.ground_target]),
            before: None,
        };
        estimate(&backend, &problem, options, watch)
    }

    #[test]
    fn points_left_out_keep_their_row_with_zero_flow() {
        let pair = street();
        let mut options = Preset::Default.options(None);
        options.ground = Ground::Mask;
        options.range_m = Some(30.0);
        let estimate = solve(&pair, &options, &Unwatched).expect("a flow");
        assert_eq!(estimate.flow.len(), pair.source.len());
        for (row, point) in pair.source.iter().enumerate() {
            let kept = !pair.ground_source[row] && point[0].abs() <= 30.0 && point[1].abs() <= 30.0;
            assert_eq!(estimate.valid[row], kept, "row {row}");
            assert!(kept || estimate.flow[row] == [0.0; 3], "row {row}");
        }
        assert_eq!(
            estimate.points,
            estimate.valid.iter().filter(|&&v| v).count()
        );
    }

    #[test]
    fn ground_that_is_found_moves_with_the_vehicle_and_takes_no_part() {
        let pair = street();
        let mut options = Preset::Default.options(None);
        let solve = |options: &Options| {
            let backend = CpuBackend::new(Some(2)).expect("threads");
            let problem = Problem {
                source: &pair.source,
                target: &pair.target,
                ground: None,
                before: None,
            };
            estimate(&backend, &problem, options, &Unwatched).expect("a flow")
        };
        let estimate = solve(&options);
        let ego = estimate.ego.expect("it is estimated");
        assert!(estimate.valid.iter().all(|&valid| valid));
        assert!(estimate.points < pair.source.len());
        let found = crate::flow::ground::segment(&pair.source, &Default::default()).ground;
        let dynamic = estimate.dynamic.expect("the ego motion is known");
        for (row, point) in pair
            .source
            .iter()
            .enumerate()
            .filter(|&(row, _)| found[row])
        {
            let to = moved(&ego, *point);
            let expected: Point = core::array::from_fn(|a| to[a] - point[a]);
            assert_eq!(estimate.flow[row], expected, "row {row}");
            assert!(!dynamic[row], "row {row}");
        }
        // Without the vehicle's motion, or sampled, it is left out.
        for (ego, max_points) in [(Ego::Off, None), (Ego::Auto, Some(500))] {
            options.ego = ego;
            options.max_points = max_points;
            let estimate = solve(&options);
            assert!((0..found.len()).all(|row| !found[row] || !estimate.valid[row]));
        }
    }

    #[test]
    fn a_deadline_gives_the_best_flow_so_far_and_a_cancellation_gives_none() {
        let pair = street();
        for preset in Preset::ALL {
            let options = preset.options(None);
            let deadline = After(3, Interrupt::Deadline, AtomicUsize::new(0));
            let estimate = solve(&pair, &options, &deadline).expect("a flow");
            assert_eq!(estimate.stop_reason, StopReason::Deadline);
            assert_eq!(estimate.iterations, 3);
            assert!(estimate.flow.iter().flatten().all(|f| f.is_finite()));
            let cancel = After(3, Interrupt::Cancelled, AtomicUsize::new(0));
            let error = solve(&pair, &options, &cancel).expect_err("cancelled");
            assert!(matches!(error, FlowError::Cancelled));
        }
    }

    #[test]
    fn a_deadline_before_the_first_iteration_still_gives_a_flow() {
        let now = After(0, Interrupt::Deadline, AtomicUsize::new(0));
        let estimate = solve(&street(), &Preset::Default.options(None), &now).expect("a flow");
        assert_eq!(estimate.iterations, 0);
        assert!(estimate.flow.iter().flatten().all(|f| f.is_finite()));
    }

    #[test]
    fn a_given_ego_motion_is_taken_as_it_is_and_marks_what_moves_against_it() {
        let pair = street();
        let mut options = Preset::Default.options(None);
        options.ego = Ego::Given(pair.target_from_source);
        options.max_iterations = 0;
        let estimate = solve(&pair, &options, &Unwatched).expect("a flow");
        assert_eq!(estimate.ego, Some(pair.target_from_source));
        assert!(
            estimate
                .dynamic
                .is_some_and(|dynamic| dynamic.iter().all(|&moves| !moves))
        );
        for (row, &point) in pair.source.iter().enumerate() {
            let to = moved(&pair.target_from_source, point);
            let expected: Point = core::array::from_fn(|a| to[a] - point[a]);
            assert_eq!(estimate.flow[row], expected);
        }
    }
}
