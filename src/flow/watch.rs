//! How the world outside looks in on an optimization: time, deadlines, cancellation, progress.
//!
//! The numerics own no clock; whoever calls them may lend one.

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
pub trait Watch: Sync {
    /// Seconds since a fixed moment; constant where nobody keeps time.
    fn seconds(&self) -> f64 {
        0.0
    }
    /// Whether the optimization should end now.
    fn interrupt(&self) -> Option<Interrupt> {
        None
    }
    /// Called after every iteration.
    fn progress(&self, _progress: Progress) {}
}

/// A watch that keeps no time and never interrupts.
#[derive(Clone, Copy, Debug, Default)]
pub struct Unwatched;

impl Watch for Unwatched {}
