//! TODO doc

use super::field::Network;
use std::sync::Arc;

use super::data::{Point, RigidTransform, transform_points};
use super::field::{Backend, BackendError};
use super::objects::ObjectMotions;

/// The motion of everything between two sweeps, at any point: where a point of the source is at the
/// target's time, in the target's frame.
#[derive(Clone, Debug)]
pub struct MotionField {
    /// The ego motion as target_from_source; none where the residual explains it as well.
    pub ego: Option<RigidTransform>,
    /// What moves against the static world.
    pub residual: Residual,
}

/// What moves of itself, over points whose ego motion is taken out.
#[derive(Clone, Debug)]
pub enum Residual {
    /// Nothing.
    Still,
    /// What a network says.
    Network(Network),
    /// Objects do, each rigidly.
    Objects(Arc<ObjectMotions>),
}

impl MotionField {
    /// Where `points` of the source's frame are in the target's if nothing moves of itself.
    pub fn static_places(&self, points: &[Point]) -> Vec<Point> {
        match &self.ego {
            None => points.to_vec(),
            Some(motion) => transform_points(motion, points),
        }
    }

    /// How far what would be at `static_places` has moved of itself, metres.
    ///
    /// # Errors
    /// [`BackendError`] where the device fails.
    pub fn residual(
        &self,
        backend: &dyn Backend,
        static_places: &[Point],
    ) -> Result<Vec<Point>, BackendError> {
        match &self.residual {
            Residual::Still => Ok(vec![[0.0; 3]; static_places.len()]),
            Residual::Network(network) => backend.evaluate(network, static_places),
            Residual::Objects(motions) => Ok(motions.residual_at(static_places)),
        }
    }
}
