//! Another sweep of the sequence, as the search for movers sees it.
//!
//! What moves at a constant velocity has moved as often by then as gaps have passed. It must not know
//! what its evidence is for.

use super::planar_motion::PlanarMotion;
use super::scene::{Scene, Thinned};
use crate::flow::options::ObjectOptions;
use crate::flow::registration::AlignedSweep;

/// A sweep at its time.
pub(super) struct NeighborView<'a> {
    pub(super) scene: Scene<'a>,
    /// Gaps after the source.
    pub(super) at: i8,
    /// What it counts, in times of the target.
    pub(super) weight: f32,
}

impl<'a> NeighborView<'a> {
    pub(super) fn new(
        source: &'a Thinned,
        sweep: &AlignedSweep,
        options: &'a ObjectOptions,
    ) -> Self {
        // A sweep is trusted the less the longer ago a velocity must have been what it is.
        let away = f32::from(sweep.at).abs().max(1.0);
        Self {
            scene: Scene::new(source, &sweep.points, options),
            at: sweep.at,
            weight: 1.0 / (away * away),
        }
    }

    /// Where a motion of one gap leads to by then.
    pub(super) fn by_then(&self, motion: &PlanarMotion) -> PlanarMotion {
        motion.repeated(self.at)
    }
}
