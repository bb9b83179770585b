//! The motion field: ego motion plus the residual motion of a network or of rigid objects.

use std::sync::Arc;

use crate::flow::data::{Point, RigidTransform, transform_points};
use crate::flow::field::{Backend, BackendError, Network};
use crate::flow::objects::ObjectMotions;

/// The motion from the source sweep's time to the target's, defined at any point. It maps a point
/// of the source's frame to its position at the target's time, in the target's frame.
#[derive(Clone, Debug)]
pub struct MotionField {
    /// Ego motion as target_from_source. None if the residual includes it.
    pub ego: Option<RigidTransform>,
    /// Motion relative to the static world.
    pub residual: Residual,
}

/// Residual motion: motion with the ego motion taken out, as a function of the static position.
#[derive(Clone, Debug)]
pub enum Residual {
    /// No residual motion.
    Still,
    /// A neural scene flow prior.
    Network(Network),
    /// Rigid motions of objects.
    Objects(Arc<ObjectMotions>),
}

impl MotionField {
    /// Transforms `points` (N x 3, metres) of the source's frame into the target's by the ego
    /// motion: their positions if they are static. Without an ego motion the points are returned
    /// unchanged.
    pub fn static_positions(&self, points: &[Point]) -> Vec<Point> {
        match &self.ego {
            None => points.to_vec(),
            Some(motion) => transform_points(motion, points),
        }
    }

    /// The residual motion (N x 3, metres) of points with these static positions, in the target's
    /// frame.
    ///
    /// # Errors
    /// [`BackendError`] if the device fails.
    pub fn residual(
        &self,
        backend: &dyn Backend,
        static_positions: &[Point],
    ) -> Result<Vec<Point>, BackendError> {
        match &self.residual {
            Residual::Still => Ok(vec![[0.0; 3]; static_positions.len()]),
            Residual::Network(network) => backend.evaluate(network, static_positions),
            Residual::Objects(motions) => Ok(motions.residual_at(static_positions)),
        }
    }
}
