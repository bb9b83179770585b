//! The loop: select, transform, align, then forward, query, backward and Adam until the end.
//!
//! FNSF Section 3: `theta* = argmin mean_p D(p + g(p; theta))`. Sees only the backend's traits.

use super::backend::{Advance, Backend};
use super::error::FlowError;
use super::options::{Ego, Options};
use super::points::{Point, RigidTransform};
use super::preprocess::{self, Problem};
use super::watch::{Interrupt, Watch};

/// Iterations that a backend may do without coming back.
const STEPS_AT_ONCE: usize = 64;

/// Residual motion of a frame from which a point counts as moving, metres (Argoverse 2).
pub const DYNAMIC_M: f32 = 0.05;

/// The motion of every point.
#[derive(Clone, Debug, PartialEq)]
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
    /// The loss of the result, metres.
    pub best_loss: f64,
    /// Why it ended.
    pub stop_reason: StopReason,
    /// What it took.
    pub seconds: PhaseSeconds,
    /// Bytes of the distance transform.
    pub distance_bytes: usize,
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
/// no error: the best flow so far comes back.
pub fn estimate(
    backend: &dyn Backend,
    problem: &Problem,
    options: &Options,
    watch: &dyn Watch,
) -> Result<Estimate, FlowError> {
    let began = watch.seconds();
    let selection = preprocess::select(problem, options)?;
    let transform = backend.transform(&selection.source, &selection.target, &options.distance)?;
    let ego = match options.ego {
        Ego::Off => None,
        Ego::Auto => Some(transform.align(&selection.source)),
        Ego::Given(target_from_source) => Some(target_from_source),
    };
    let aligned = match &ego {
        None => selection.source.clone(),
        Some(motion) => selection
            .source
            .iter()
            .map(|&point| moved(motion, point))
            .collect(),
    };
    let distance_bytes = transform.bytes();
    let mut trainer = transform.start(&aligned, options)?;
    let precomputed = watch.seconds();

    let stop_reason = loop {
        match trainer.advance(STEPS_AT_ONCE, watch)? {
            Advance::Continues => {}
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
    let residual = trainer.evaluate(&aligned)?;

    let mut flow = vec![[0.0; 3]; problem.source.len()];
    let mut valid = vec![false; problem.source.len()];
    let mut dynamic = ego.map(|_| vec![false; problem.source.len()]);
    for (i, &row) in selection.rows.iter().enumerate() {
        let (from, to, residual) = (selection.source[i], aligned[i], residual[i]);
        flow[row] = core::array::from_fn(|a| (to[a] - from[a]) + residual[a]);
        valid[row] = true;
        if let Some(dynamic) = &mut dynamic {
            let square: f32 = residual.iter().map(|r| r * r).sum();
            dynamic[row] = square >= DYNAMIC_M * DYNAMIC_M;
        }
    }
    let report = trainer.report();
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
        stop_reason,
        seconds: PhaseSeconds {
            precompute: precomputed - began,
            query: report.query_seconds,
            network: total - (precomputed - began) - report.query_seconds,
            total,
        },
        distance_bytes,
    })
}

/// `point`, moved rigidly.
fn moved(motion: &RigidTransform, point: Point) -> Point {
    let moved = motion * nalgebra::Point3::from(point.map(f64::from));
    [moved.x as f32, moved.y as f32, moved.z as f32]
}
