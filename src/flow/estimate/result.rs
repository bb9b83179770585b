//! The result of an estimate.

use crate::flow::data::{Point, RigidTransform, StopReason};
use crate::flow::motion::MotionField;
use crate::flow::objects::Objects;

/// The motion of every source point of a pair.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// N displacements from the source sweep's time to the target's, metres, ego motion included:
    /// the position in the target's frame minus the position in the source's frame. Zero where
    /// `valid` is false.
    pub flow: Vec<Point>,
    /// N flags: true for points with a flow.
    pub valid: Vec<bool>,
    /// N flags: true for points whose residual motion is at least [`crate::flow::DYNAMIC_M`]. None
    /// where the ego motion is unknown.
    pub dynamic: Option<Vec<bool>>,
    /// The ego motion as target_from_source, where it was given or estimated.
    pub ego: Option<RigidTransform>,
    /// Number of points that took part and have a flow. Ground points with the ego-motion flow
    /// alone are not counted.
    pub points: usize,
    /// Results of the method besides the flow.
    pub solution: Solution,
    /// The reason why the method ended.
    pub stop_reason: StopReason,
    /// Name of the processor that ran the method, for reports: the device of a field, or the host's
    /// threads for objects.
    pub device: String,
    /// Seconds of the preparation: selection, distance transform and ego motion.
    pub precompute_seconds: f64,
    /// Seconds of all phases, by the control's clock.
    pub total_seconds: f64,
    /// The motion at any point in space, not only at the source points.
    pub motion: MotionField,
}

impl Estimate {
    /// Seconds of the method: the object search, or the fit of the field with its distance queries.
    pub fn method_seconds(&self) -> f64 {
        self.total_seconds - self.precompute_seconds
    }

    /// The objects, for [`crate::flow::Method::Objects`].
    pub fn objects(&self) -> Option<&Objects> {
        match &self.solution {
            Solution::Objects(solution) => Some(&solution.objects),
            Solution::Field(_) => None,
        }
    }

    /// The outcome of the fit, for [`crate::flow::Method::Field`].
    pub fn fit(&self) -> Option<&FieldSolution> {
        match &self.solution {
            Solution::Field(solution) => Some(solution),
            Solution::Objects(_) => None,
        }
    }
}

/// Results of a method besides the flow.
#[derive(Clone, Debug)]
pub enum Solution {
    /// Of [`crate::flow::Method::Objects`].
    Objects(ObjectSolution),
    /// Of [`crate::flow::Method::Field`].
    Field(FieldSolution),
}

/// The outcome of an object search.
#[derive(Clone, Debug)]
pub struct ObjectSolution {
    /// The clusters of the source with their boxes and motions.
    pub objects: Objects,
    /// Number of candidates that were searched: all of them, unless a deadline passed.
    pub searched: usize,
    /// Number of candidates: clusters before fragments of one moving object were merged.
    pub candidates: usize,
    /// Mean truncated distance of the searched clusters' points to the target after their motion,
    /// metres, averaged over the clusters: the objective of the search. Infinite where the search
    /// did not start.
    pub cost_m: f64,
}

/// The outcome of the fit of a field.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldSolution {
    /// Completed iterations; zero where the deadline allowed none.
    pub iterations: usize,
    /// Iteration limit, after a deadline may have shortened it.
    pub max_iterations: usize,
    /// Iteration, from 1, whose field is the result; the last one for an average.
    pub best_iteration: usize,
    /// Loss of that iteration, metres. Comparable within one preset and pair; infinite without an
    /// iteration.
    pub best_loss: f64,
    /// Bytes of the distance transform.
    pub distance_bytes: usize,
    /// Seconds of the distance queries in this run, without those before a resumed snapshot. CPU: the
    /// mean over the threads. GPU: extrapolated from the timestamps of each submission's first
    /// iteration, zero where the GPU has no timestamps.
    pub query_seconds: f64,
}
