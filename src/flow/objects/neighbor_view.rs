//! A neighbor sweep, prepared for the object search.
//!
//! At constant velocity, a cluster has moved once for each sweep interval between the source and
//! the neighbor sweep.

use super::clouds::{SourceCloud, TargetCloud};
use super::planar_motion::PlanarMotion;
use super::scene::Scene;
use crate::flow::data::AlignedSweep;
use crate::flow::options::ObjectOptions;

/// A neighbor sweep with its time and weight.
pub(super) struct NeighborView<'a> {
    pub(super) scene: Scene<'a>,
    /// Its time in sweep intervals after the source.
    pub(super) at: i8,
    /// Weight of its costs, where the target has a weight of 1.
    pub(super) weight: f32,
}

impl<'a> NeighborView<'a> {
    /// From a sweep and its downsampled points.
    pub(super) fn new(
        source: &'a SourceCloud,
        sweep: &AlignedSweep,
        cloud: &TargetCloud,
        options: &'a ObjectOptions,
    ) -> Self {
        // The weight falls with the square of the time difference, over which the velocity may have
        // changed.
        let away = f32::from(sweep.at).abs().max(1.0);
        Self {
            scene: Scene::new(source, cloud, options),
            at: sweep.at,
            weight: 1.0 / (away * away),
        }
    }

    /// The motion from the source to this sweep's time, for a motion of one sweep interval.
    pub(super) fn by_then(&self, motion: &PlanarMotion) -> PlanarMotion {
        motion.repeated(self.at)
    }
}
