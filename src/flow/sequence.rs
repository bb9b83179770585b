//! A sequence: sweeps in, the motion of each consecutive pair out.
//!
//! Keeps the last sweep and the last pair's field, whatever the length. Each fit starts from the
//! field before it, carried into the new frame, where that explains the new pair (`solver.rs` says
//! how it is judged); the vehicle's motion is sought about the one before. Knows no files.

use super::backend::Backend;
use super::error::FlowError;
use super::field::Field;
use super::options::{Ego, Options};
use super::points::{Point, RigidTransform};
use super::preprocess::Problem;
use super::solver::{Estimate, estimate};
use super::watch::Watch;

/// One sweep of a sequence.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sweep {
    /// N points, metres, in the sensor's frame of the sweep.
    pub points: Vec<Point>,
    /// N flags: which points are ground, where the sweep says so.
    pub ground: Option<Vec<bool>>,
}

/// The pairs of a sequence, one after the other.
pub struct Sequence<'a> {
    backend: &'a dyn Backend,
    options: Options,
    last: Option<Sweep>,
    before: Option<Field>,
}

impl<'a> Sequence<'a> {
    /// A sequence whose pairs are estimated by `options`.
    pub fn new(backend: &'a dyn Backend, options: Options) -> Self {
        Self {
            backend,
            options,
            last: None,
            before: None,
        }
    }

    /// Takes the next sweep, and gives the motion from the one before to it; nothing for the first.
    /// Where the vehicle's motion target_from_source is known, `ego` says it.
    ///
    /// # Errors
    /// As [`estimate`]; the sequence goes on afresh with this sweep.
    pub fn push(
        &mut self,
        sweep: Sweep,
        ego: Option<RigidTransform>,
        watch: &dyn Watch,
    ) -> Result<Option<Estimate>, FlowError> {
        let before = self.before.take();
        let Some(last) = self.last.replace(sweep) else {
            return Ok(None);
        };
        let Some(sweep) = &self.last else {
            return Ok(None);
        };
        let mut options = self.options.clone();
        if let Some(motion) = ego {
            options.ego = Ego::Given(motion);
        }
        let ground = last.ground.as_deref().zip(sweep.ground.as_deref());
        let problem = Problem {
            source: &last.points,
            target: &sweep.points,
            ground: ground.map(|(source, target)| [source, target]),
            before: before.as_ref(),
        };
        let estimate = estimate(self.backend, &problem, &options, watch)?;
        self.before = Some(estimate.field.clone());
        Ok(Some(estimate))
    }
}
