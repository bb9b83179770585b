//! TODO doc

use super::coarse;
use super::gicp::{Fit, Schedule};
use super::surfels::{Columns, Surfels};
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::spatial::voxel_mean;

/// Side of the voxels that both clouds are thinned to, metres.
const VOXEL_M: f32 = 0.25;
/// Normals are taken, and matches are sought, within this, metres: wide enough for two rings of
/// 64 beams.
const CELL_M: f32 = 0.8;
/// Source points that are looked at: enough for millimetres.
const REFINED: usize = 8192;
/// How the motion is refined: from where the search ends, down to the noise of a lidar.
const REFINEMENT: Schedule = Schedule {
    steps: 12,
    within_m: [0.8, 0.5],
    scale_m: [0.3, 0.1],
};

/// A cloud as it is aligned, as source or as target: what alignments need of it alone.
pub(crate) struct SurfelCloud {
    coarse: Surfels,
    fine: Surfels,
}

impl SurfelCloud {
    /// The surface of a cloud, ground and all.
    pub(crate) fn new(points: &[Point]) -> Self {
        let thin = voxel_mean(points, VOXEL_M);
        Self {
            coarse: coarse::coarse(&thin),
            fine: Surfels::new(Columns::new(&thin, CELL_M)),
        }
    }
}

/// The motion target_from_source that aligns `source` with `target`, sought around `prior`; the
/// motion so far where the watch interrupts. Where the clouds leave a direction free, it stays as
/// in `prior`; so does all of it where they have nothing in common.
///
/// The same bits whatever the number of threads.
pub(crate) fn align(
    source: &SurfelCloud,
    target: &SurfelCloud,
    prior: &RigidTransform,
    control: &dyn Control,
) -> RigidTransform {
    let found = coarse::search(&source.coarse, &target.coarse, prior, control);
    if control.interrupt().is_some() {
        return found;
    }
    let target = target.fine.all();
    let source = source.fine.some(REFINED);
    Fit::new(&source, target).run(&found, &REFINEMENT, control)
}
