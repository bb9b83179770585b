//! Registration of two clouds: a coarse search, then a refinement.

use nalgebra::Matrix6;

use super::coarse;
use super::gicp::{Fit, Schedule};
use super::posterior::Prior;
use super::surfels::Surfels;
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::spatial::voxel_mean;

/// Side of the voxels that both clouds are downsampled to, metres.
const VOXEL_M: f32 = 0.25;
/// Radius of the neighborhoods of normals, and range of matches, metres: wide enough for two rings
/// of a 64-beam lidar.
const CELL_M: f32 = 0.8;
/// Source points used by the refinement: enough for millimetre accuracy.
const REFINED: usize = 8192;
/// Schedule of the refinement: from the accuracy of the coarse search down to the noise of a lidar.
const REFINEMENT: Schedule = Schedule {
    steps: 12,
    within_m: [0.8, 0.5],
    scale_m: [0.3, 0.1],
};

/// The surfels of a cloud, as a source or a target of registrations. They depend on this cloud
/// only.
pub(crate) struct SurfelCloud {
    coarse: Surfels,
    fine: Surfels,
}

impl SurfelCloud {
    /// Surfels of `points`, metres, ground included.
    pub(crate) fn new(points: &[Point]) -> Self {
        let thin = voxel_mean(points, VOXEL_M);
        Self {
            coarse: coarse::coarse(&thin),
            fine: Surfels::new(&thin, CELL_M),
        }
    }
}

/// The ego motion of a pair, and how certain it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Registration {
    /// The rigid motion `target_from_source`.
    pub motion: RigidTransform,
    /// 6 x 6 covariance of the position of the source's origin (x, y, z, metres) and of the rotation
    /// about the axes x, y, z (radians), in the target's frame. None where an interrupt left no time
    /// for it.
    pub covariance: Option<Matrix6<f64>>,
}

impl Registration {
    /// A motion that is known from elsewhere.
    pub(crate) fn given(motion: RigidTransform) -> Self {
        Self {
            motion,
            covariance: None,
        }
    }
}

/// The most probable rigid motion `target_from_source` that aligns `source` with `target`, searched
/// around `prior`, for a sensor on a vehicle. Where `control` interrupts, it is the motion so far.
/// In directions that the clouds do not determine, the motion stays as in `prior`. It equals `prior`
/// where the clouds have nothing in common.
///
/// The result is bit-identical for any number of threads.
pub(crate) fn align(
    source: &SurfelCloud,
    target: &SurfelCloud,
    prior: &RigidTransform,
    control: &dyn Control,
) -> Registration {
    let found = coarse::search(&source.coarse, &target.coarse, prior, control);
    if control.interrupt().is_some() {
        return Registration::given(found);
    }
    let source = source.fine.some(REFINED);
    let prior = Prior::of_vehicle(prior);
    let (motion, covariance) =
        Fit::new(&source, &target.fine).run_with(&prior, &found, &REFINEMENT, control);
    Registration { motion, covariance }
}
