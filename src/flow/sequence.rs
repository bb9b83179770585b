//! A sequence: sweeps in, the motion of each consecutive pair out.
//!
//! Keeps the last sweep and the last pair's field, whatever the length. Each fit starts from the
//! field before it, carried into the new frame, where the options have a warm start and that explains
//! the new pair (`warm_start.rs` says how it is judged); the vehicle's motion is sought about the one
//! before then. Knows no files.

use super::backend::Backend;
use super::error::FlowError;
use super::field::Field;
use super::options::{Ground, Options};
use super::points::Point;
use super::preprocess::{Problem, ground_of, is_in_range};
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

impl Sweep {
    /// The sweep as `options` take it: its ground found where it is wanted and not known, and
    /// forgotten where it is kept.
    #[must_use]
    pub fn prepared(mut self, options: &Options) -> Self {
        match options.ground {
            Ground::Keep => self.ground = None,
            Ground::Mask => {}
            Ground::Auto if self.ground.is_some() => {}
            Ground::Auto => self.ground = Some(ground_of(&self.points, options)),
        }
        self
    }

    /// The points alone that `options` let take part in a dense cloud: those in range.
    #[must_use]
    pub fn cropped(self, options: &Options) -> Self {
        let rows: Vec<usize> = (0..self.points.len())
            .filter(|&row| is_in_range(self.points[row], options))
            .collect();
        Self {
            points: rows.iter().map(|&row| self.points[row]).collect(),
            ground: self
                .ground
                .map(|ground| rows.iter().map(|&row| ground[row]).collect()),
        }
    }
}

/// The pairs of a sequence, one after the other.
#[derive(Clone, Debug, Default)]
pub struct Sequence {
    last: Option<Sweep>,
    before: Option<Field>,
}

impl Sequence {
    /// Takes the next sweep, and gives the motion from the one before to it by `options`; nothing for
    /// the first. Options may change from sweep to sweep: where the vehicle's motion is known,
    /// [`super::Ego::Given`] says it.
    ///
    /// # Errors
    /// As [`estimate`]; the sequence is left as it was, and the sweep may be pushed again.
    pub fn push(
        &mut self,
        backend: &dyn Backend,
        sweep: Sweep,
        options: &Options,
        watch: &dyn Watch,
    ) -> Result<Option<Estimate>, FlowError> {
        // Once for both of its pairs.
        let sweep = sweep.prepared(options);
        let Some(last) = &self.last else {
            self.last = Some(sweep);
            return Ok(None);
        };
        let ground = last.ground.as_deref().zip(sweep.ground.as_deref());
        let problem = Problem {
            source: &last.points,
            target: &sweep.points,
            ground: ground.map(|(source, target)| [source, target]),
            before: self.before.as_ref(),
        };
        let estimate = estimate(backend, &problem, options, watch)?;
        self.before = Some(estimate.field.clone());
        self.last = Some(sweep);
        Ok(Some(estimate))
    }
}
