//! Control of a running computation: time, deadline, interruption, progress and snapshots.
//!
//! The numerics read no clock. The caller may provide one through [`Control`].

/// Progress of a method.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progress {
    /// Finished iterations of a field's fit, or finished clusters of an object search.
    pub done: usize,
    /// Maximum number of iterations, or number of clusters.
    pub total: usize,
    /// Mean loss of the latest iteration's points, in the unit of the loss
    /// ([`crate::flow::LossOptions::unit`]). For an object search, the mean truncated distance of
    /// the finished clusters from the target, metres.
    pub loss: f64,
}

/// Why a computation is to end early.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interrupt {
    /// The deadline has passed: the best result so far is returned.
    Deadline,
    /// The computation was cancelled; its result is not needed.
    Cancelled,
}

/// The caller's control of a computation. By default it keeps no time and never interrupts.
pub trait Control: Sync {
    /// Seconds since a fixed time; constant if no time is kept.
    fn seconds(&self) -> f64 {
        0.0
    }
    /// Seconds until the result is due, negative after that; none without a deadline. If the time
    /// does not suffice for all of the work, less is computed. An implementation that returns a
    /// value must keep time in [`Self::seconds`].
    fn seconds_left(&self) -> Option<f64> {
        None
    }
    /// The reason why the work should end now; none to continue.
    ///
    /// Called from any thread, usually several times a second: before each iteration or group of
    /// iterations of a fit, before each group of clusters of an object search, and between the
    /// parts of the work before them. It can therefore serve as a heartbeat.
    fn interrupt(&self) -> Option<Interrupt> {
        None
    }
    /// Receives the progress of each iteration of a fit, or of each group of clusters of an object
    /// search. Iterations that a GPU does as a group are reported after the group.
    fn progress(&self, _progress: Progress) {}
    /// Whether a snapshot of the fit is due. An implementation keeps it true until
    /// [`Self::snapshot`] has been called. Checked after [`Self::interrupt`], before each iteration
    /// or group of iterations.
    fn snapshot_due(&self) -> bool {
        false
    }
    /// Receives the bytes of a due snapshot, about 1.9 MB for a network, to be read by
    /// [`crate::flow::Snapshot::from_bytes`]. Only the fit of a field produces snapshots, and none
    /// after its deadline has altered it.
    fn snapshot(&self, _bytes: Vec<u8>) {}
}

/// The control's interrupt as an error.
pub(crate) fn check(control: &dyn Control) -> Result<(), Interrupt> {
    control.interrupt().map_or(Ok(()), Err)
}

/// A control that keeps no time and never interrupts.
#[derive(Clone, Copy, Debug, Default)]
pub struct Uncontrolled;

impl Control for Uncontrolled {}

/// A control with an earlier deadline.
pub(crate) struct EarlierDeadline<'a> {
    pub(crate) control: &'a dyn Control,
    /// Seconds by which the deadline is earlier.
    pub(crate) reserve: f64,
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
    fn snapshot(&self, bytes: Vec<u8>) {
        self.control.snapshot(bytes);
    }
}
