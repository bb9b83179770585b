//! The common interface of the two methods: input and result.

use super::result::Solution;
use crate::flow::data::StopReason;
use crate::flow::data::{Control, Interrupt, Point, RigidTransform, transform_points};
use crate::flow::error::FlowError;
use crate::flow::motion::Residual;
use crate::flow::options::Options;
use crate::flow::problem::Problem;
use crate::flow::select::Selection;

/// The input of a method.
pub(super) struct Input<'a> {
    pub(super) problem: &'a Problem<'a>,
    pub(super) options: &'a Options,
    pub(super) selection: &'a Selection,
    pub(super) control: &'a dyn Control,
}

impl Input<'_> {
    /// The selected source points, transformed by the ego motion where there is one.
    pub(super) fn aligned(&self, ego: Option<&RigidTransform>) -> Vec<Point> {
        let source = &self.selection.source;
        ego.map_or_else(|| source.clone(), |motion| transform_points(motion, source))
    }

    /// Returns early if the control has cancelled; a deadline is not an error.
    ///
    /// # Errors
    /// [`FlowError::Cancelled`] where the control has cancelled.
    pub(super) fn check_cancelled(&self) -> Result<(), FlowError> {
        match self.control.interrupt() {
            Some(Interrupt::Cancelled) => Err(FlowError::Cancelled),
            Some(Interrupt::Deadline) | None => Ok(()),
        }
    }
}

/// The result of a method, one row per selected source point.
pub(super) struct Solved {
    pub(super) ego: Option<RigidTransform>,
    /// The selected source points, transformed by the ego motion into the target's frame.
    pub(super) aligned: Vec<Point>,
    /// Residual displacement of each aligned point, metres, in the target's frame.
    pub(super) residual: Vec<Point>,
    /// The residual motion at any point.
    pub(super) motion: Residual,
    pub(super) solution: Solution,
    pub(super) stop_reason: StopReason,
    pub(super) device: String,
    /// End of the preparation (selection, distance transform, ego motion), in seconds of the
    /// control's clock.
    pub(super) precomputed_at: f64,
}
