//! The input of an estimate: a pair of sweeps with optional masks, prior and neighbor sweeps.

use super::data::Point;
use super::motion::MotionField;

/// A pair of unprocessed sweeps.
#[derive(Clone, Copy, Debug)]
pub struct Problem<'a> {
    /// N points of the earlier sweep, metres, in its sensor frame.
    pub source: &'a [Point],
    /// M points of the later sweep, metres, in its sensor frame.
    pub target: &'a [Point],
    /// N and M flags: true for ground points. Required by [`super::Ground::Mask`]. With
    /// [`super::Ground::Auto`] the ground is segmented where the masks are absent.
    pub ground: Option<[&'a [bool]; 2]>,
    /// The motion field of the previous pair, whose target is this pair's source. A field fit with
    /// a warm start uses it as its initial guess and as the prior of the ego motion. None for an
    /// independent pair.
    pub before: Option<&'a MotionField>,
    /// Other sweeps of the sequence, in any order; empty for an independent pair. Used where
    /// [`super::ObjectOptions::sweeps`] is more than two.
    pub neighbors: &'a [NeighborSweep<'a>],
}

/// A neighbor sweep: another sweep of the same sequence.
#[derive(Clone, Copy, Debug)]
pub struct NeighborSweep<'a> {
    /// Points, metres, in the sensor frame of the sweep.
    pub points: &'a [Point],
    /// One flag per point: true for ground points, as in [`Problem::ground`].
    pub ground: Option<&'a [bool]>,
    /// Time of the sweep, in sweep intervals after the source. The target is at 1, the sweep before
    /// the source at -1.
    pub at: i8,
}

impl<'a> Problem<'a> {
    /// A pair without ground masks, prior and neighbor sweeps.
    pub fn pair(source: &'a [Point], target: &'a [Point]) -> Self {
        Self {
            source,
            target,
            ground: None,
            before: None,
            neighbors: &[],
        }
    }

    /// The neighbor sweeps used by an estimate from `sweeps` sweeps in total: those nearest in time
    /// to the middle of the pair, nearest first. At equal distance the earlier sweep comes first.
    pub(crate) fn nearest_neighbors(&self, sweeps: usize) -> Vec<&'a NeighborSweep<'a>> {
        let mut order: Vec<&NeighborSweep> = self.neighbors.iter().collect();
        order.sort_by_key(|sweep| ((2 * i16::from(sweep.at) - 1).abs(), sweep.at));
        order.truncate(sweeps.saturating_sub(2));
        order
    }
}
