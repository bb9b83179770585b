//! The input of an estimate: a pair of sweeps with optional masks, prior and neighbor sweeps.

use super::data::Point;
use super::error::FlowError;
use super::motion::MotionField;

/// The input of an estimate: a pair of raw sweeps, with optional ground masks, previous motion
/// field and neighbor sweeps.
#[derive(Clone, Copy, Debug)]
pub struct Problem<'a> {
    /// N points of the earlier sweep, metres, in its sensor frame. Points that are not finite take
    /// no part and get no flow.
    pub source: &'a [Point],
    /// M points of the later sweep, metres, in its sensor frame. Points that are not finite take no
    /// part.
    pub target: &'a [Point],
    /// N and M flags: true for ground points. Required by [`super::Ground::Mask`] and ignored by
    /// [`super::Ground::Keep`]. With [`super::Ground::Auto`] the ground is segmented where the
    /// masks are absent.
    pub ground: Option<[&'a [bool]; 2]>,
    /// N and M times of the points, seconds after the time of their sweep; it may be negative. With
    /// them and an ego motion the sweeps are deskewed where they fit better then. A point whose time is
    /// not finite is then left out like one that is not finite. None where they are unknown: each sweep
    /// then counts as measured at one instant.
    pub times: Option<[&'a [f32]; 2]>,
    /// The motion field of the previous pair, whose target is this pair's source. None for an
    /// independent pair.
    ///
    /// Only a field fit with [`super::FieldOptions::warm_start`] uses it. Its ego motion is then
    /// the prior of the registration. The fit starts from its network if two conditions hold. The
    /// loss of the network on this pair is lower than that of zero residual motion. Either both
    /// pairs or neither have an ego motion.
    pub before: Option<&'a MotionField>,
    /// Other sweeps of the sequence, in any order; empty for an independent pair. An object search
    /// uses at most [`super::Options::sweeps`] minus two of them: those nearest in time to the
    /// middle of the pair. Without an ego motion it uses none. A deadline may drop some.
    pub neighbors: &'a [NeighborSweep<'a>],
}

/// A neighbor sweep: another sweep of the same sequence.
#[derive(Clone, Copy, Debug)]
pub struct NeighborSweep<'a> {
    /// K points, metres, in the sensor frame of the sweep.
    pub points: &'a [Point],
    /// K flags: true for ground points, as in [`Problem::ground`].
    pub ground: Option<&'a [bool]>,
    /// K times of the points, as in [`Problem::times`].
    pub times: Option<&'a [f32]>,
    /// Time of the sweep, in sweep intervals after the source. The sweep before the source is at
    /// -1, the sweep after the target at 2. The values 0 and 1 are the pair itself; they are not
    /// rejected but count its sweeps twice.
    pub at: i8,
}

impl<'a> Problem<'a> {
    /// A pair without ground masks, times, previous motion field and neighbor sweeps.
    pub fn pair(source: &'a [Point], target: &'a [Point]) -> Self {
        Self {
            source,
            target,
            ground: None,
            times: None,
            before: None,
            neighbors: &[],
        }
    }

    /// Checks that all times have one row per point.
    ///
    /// # Errors
    /// [`FlowError::TimesLength`].
    pub(crate) fn check_times(&self) -> Result<(), FlowError> {
        let pair = [("source", self.source), ("target", self.target)];
        let pair = pair.into_iter().zip(self.times.into_iter().flatten());
        let neighbors = self.neighbors.iter();
        let neighbors =
            neighbors.filter_map(|sweep| Some((("neighbor sweep", sweep.points), sweep.times?)));
        for ((cloud, points), times) in pair.chain(neighbors) {
            let [points, times] = [points.len(), times.len()];
            if points != times {
                return Err(FlowError::TimesLength {
                    cloud,
                    times,
                    points,
                });
            }
        }
        Ok(())
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
