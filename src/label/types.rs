//! The input and the outcome of a run.

use serde::Serialize;

use super::layout::Layout;
use super::places::Place;
use super::plan::Plan;
use super::report::RowReport;
use super::shard::Shard;
use crate::flow::field::Backend;
use crate::flow::{Estimate, FlowError};
use crate::job::JobOptions;

/// What is labelled, how, and where to.
#[derive(Clone, Debug)]
pub struct Inputs<'a> {
    /// All pairs.
    pub plan: &'a Plan,
    /// The options of the estimates.
    pub options: &'a JobOptions,
    /// How the outputs lie.
    pub layout: Layout,
    /// Whether the ego motion is that of the plan's poses.
    pub poses: bool,
    /// Whether tracks are written, and correct the flows. A drive is then done by one process.
    pub tracks: bool,
    /// Where the masks of [`Layout::needs_masks`] are: `DRIVE/TIMESTAMP.feather` with a column `mask`.
    pub masks: Option<Place>,
    /// Whether the times of points are not read, so that no sweep is deskewed.
    pub ignore_times: bool,
    /// Memory that the estimate of a pair may take, bytes. A pair that needs more is refused.
    pub most_bytes: usize,
    /// The part of the plan.
    pub shard: Shard,
    /// Where the outputs go.
    pub output: Place,
}

impl<'a> Inputs<'a> {
    /// A run over all pairs of a plan, in the default layout, with any amount of memory.
    pub fn new(plan: &'a Plan, options: &'a JobOptions, output: Place) -> Self {
        Self {
            plan,
            options,
            layout: Layout::default(),
            poses: false,
            tracks: false,
            masks: None,
            ignore_times: false,
            most_bytes: usize::MAX,
            shard: Shard::default(),
            output,
        }
    }
}

/// Computes estimates, on a device that it may exchange.
pub trait Solver {
    /// Does `work` on its device.
    ///
    /// # Errors
    /// Those of `work`.
    fn solve(
        &mut self,
        work: &dyn Fn(&dyn Backend) -> Result<Estimate, FlowError>,
    ) -> Result<Estimate, FlowError>;
}

/// How far a run is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Told {
    /// Pairs of the shard whose output is there, or that were refused.
    pub done: usize,
    /// Pairs of the shard.
    pub total: usize,
    /// Pairs that were refused.
    pub refused: usize,
    /// Pairs a second of this process.
    pub pairs_per_second: f64,
    /// Seconds to the end at this rate.
    pub seconds_left: f64,
}

/// The end of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Done {
    /// Pairs of the shard.
    pub pairs: usize,
    /// Pairs whose output was there before.
    pub found: usize,
    /// Pairs that this process labelled.
    pub labelled: usize,
    /// Pairs that another process labelled meanwhile.
    pub raced: usize,
    /// Pairs that cannot be labelled.
    pub refused: usize,
    /// Pairs that failed, and may succeed when they are tried again.
    pub failed: usize,
    /// Whether it was asked to stop before the end.
    pub stopped: bool,
    /// Seconds of the whole run.
    pub seconds: f64,
    /// The reports of refused and failed pairs, of the first thousand.
    pub troubles: Vec<RowReport>,
}

impl Done {
    /// Whether nothing is left to try again.
    pub fn is_complete(&self) -> bool {
        self.failed == 0 && !self.stopped
    }
}
