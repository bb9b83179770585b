//! The motion field: ego motion plus the residual motion of a network or of rigid objects.

use std::sync::Arc;

use super::samples::SampledMotion;
use crate::flow::data::{Point, RigidTransform, transform_points};
use crate::flow::field::{Backend, BackendError, LinearField, Network};
use crate::flow::objects::ObjectMotions;

/// The motion from the source sweep's time to the target's, defined at any point. It maps a point
/// of the source's frame to its position at the target's time, in the target's frame.
#[derive(Clone, Debug)]
pub struct MotionField {
    /// Ego motion as target_from_source. None where it is unknown: the residual motion is then the
    /// full motion.
    pub ego: Option<RigidTransform>,
    /// Motion relative to the static world, in the target's frame.
    pub residual: Residual,
}

/// Residual motion: the motion with the ego motion taken out, as a function of the static position.
/// The static position is where a static point would be in the target's frame.
#[derive(Clone, Debug)]
pub enum Residual {
    /// No residual motion.
    Still,
    /// The network of a fitted field: a neural scene flow prior (FNSF Section 3).
    Network(Network),
    /// The linear model of a fitted field.
    Linear(LinearField),
    /// Rigid motions of the objects that an object search found.
    Objects(Arc<ObjectMotions>),
    /// The displacements of the source points, from fields fitted to their clusters.
    Sampled(Arc<SampledMotion>),
}

impl Residual {
    /// Whether the motion is known at the source's points alone. A position half a metre away from
    /// them does not move. Other motions are functions of space.
    pub(crate) fn is_known_at_points(&self) -> bool {
        matches!(self, Self::Objects(_) | Self::Sampled(_))
    }

    /// The motion back to the source's time, as a function of the position at the target's time.
    /// `None` for a function of space, which has to be inverted position by position.
    pub(crate) fn reversed(&self) -> Option<Self> {
        match self {
            Self::Still => Some(Self::Still),
            Self::Network(_) | Self::Linear(_) => None,
            Self::Objects(motions) => Some(Self::Objects(Arc::new(motions.reversed()))),
            Self::Sampled(motion) => Some(Self::Sampled(Arc::new(motion.reversed()))),
        }
    }
}

impl MotionField {
    /// Transforms `points` (N x 3, metres) of the source's frame into the target's frame by the ego
    /// motion: N x 3 static positions, metres. Without an ego motion the points are returned
    /// unchanged.
    pub fn static_positions(&self, points: &[Point]) -> Vec<Point> {
        match &self.ego {
            None => points.to_vec(),
            Some(motion) => transform_points(motion, points),
        }
    }

    /// The residual motion in one sweep interval of N points: N x 3 displacements, metres, in the
    /// target's frame.
    ///
    /// `static_positions` (N x 3, metres) are the points as [`Self::static_positions`] returns
    /// them.
    ///
    /// # Errors
    /// [`BackendError::Memory`], [`BackendError::Busy`], [`BackendError::Lost`] or
    /// [`BackendError::Device`] if a GPU that evaluates a network has no memory for the points or
    /// fails. A CPU never fails.
    pub fn residual(
        &self,
        backend: &dyn Backend,
        static_positions: &[Point],
    ) -> Result<Vec<Point>, BackendError> {
        match &self.residual {
            Residual::Still => Ok(vec![[0.0; 3]; static_positions.len()]),
            Residual::Network(network) => backend.evaluate(network, static_positions),
            Residual::Linear(field) => Ok(field.flow(static_positions, backend.host().threads())),
            Residual::Objects(motions) => {
                let threads = backend.host().threads();
                Ok(threads.install(|| motions.residual_at(static_positions)))
            }
            Residual::Sampled(motion) => {
                let threads = backend.host().threads();
                Ok(threads.install(|| motion.displacements_at(static_positions)))
            }
        }
    }
}
