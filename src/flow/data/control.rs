//! How the world outside looks in on an optimization: time, deadlines, cancellation, progress,
//! snapshots.
//!
//! The numerics own no clock; whoever calls them may lend one.

use crate::flow::field::Snapshot;

/// One iteration's news.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Iterations done.
    pub iteration: usize,
    /// Iterations at most.
    pub max_iterations: usize,
    /// Mean loss of the iteration's points, metres: for the published method the distance to the
    /// target.
    pub loss: f64,
}

/// Why an optimization is asked to end early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interrupt {
    /// Time is up: the best flow so far is wanted.
    Deadline,
    /// Nobody wants the flow any more.
    Cancelled,
}

/// Looked at before every iteration; every method has a default that asks for nothing.
pub trait Control: Sync {
    /// Seconds since a fixed moment; constant where nobody keeps time.
    fn seconds(&self) -> f64 {
        0.0
    }
    /// Seconds until the flow must be there; none without a deadline. Where they do not hold all
    /// of the work, less is done. A watch that gives them keeps time in [`Self::seconds`].
    fn seconds_left(&self) -> Option<f64> {
        None
    }
    /// Whether the work should end now. Asked before every iteration and between the pieces of
    /// what comes before the first, several times a second and from any thread: a sign of life.
    fn interrupt(&self) -> Option<Interrupt> {
        None
    }
    /// Called after every iteration.
    fn progress(&self, _progress: Progress) {}
    /// Whether a snapshot is wanted: true until [`Self::snapshot`] has brought one. Asked before
    /// every iteration, after [`Self::interrupt`].
    fn snapshot_due(&self) -> bool {
        false
    }
    /// Takes a snapshot that was due. None comes of a run that its deadline has already changed.
    fn snapshot(&self, _snapshot: Snapshot) {}
}

/// The watch's wish to end, as an error.
pub(crate) fn check(control: &dyn Control) -> Result<(), Interrupt> {
    control.interrupt().map_or(Ok(()), Err)
}

/// A watch that keeps no time and never interrupts.
#[derive(Clone, Copy, Debug, Default)]
pub struct Uncontrolled;

impl Control for Uncontrolled {}
