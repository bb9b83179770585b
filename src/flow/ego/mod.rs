//! Ego motion: the rigid motion that carries most source points onto the target.
//!
//! ```text
//! two clouds - thinned - search: nine starts on coarse surfels - refinement on fine ones - motion
//! ```
//!
//! Plane to plane on evenly thinned clouds, robustly weighted, from a prior. Needs the ground, which
//! alone holds pitch, roll and height. It must not know of fields, flows or distance transforms.

// What the clouds are made of, how a motion is fitted to them, and from where.
mod fit;
mod search;
mod surfels;
mod thin;

#[cfg(test)]
mod tests;

use fit::{Fit, Schedule};
use surfels::{Columns, Surfels};
use thin::thinned;

use super::points::{Point, RigidTransform};
use super::watch::Watch;

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

/// The motion target_from_source that aligns `source` with `target`, sought around `prior`; the
/// motion so far where the watch interrupts. Where the clouds leave a direction free, it stays as
/// in `prior`; so does all of it where they have nothing in common.
///
/// The same bits whatever the number of threads.
pub(crate) fn align(
    source: &[Point],
    target: &[Point],
    prior: &RigidTransform,
    watch: &dyn Watch,
) -> RigidTransform {
    let (source, target) = rayon::join(|| thinned(source, VOXEL_M), || thinned(target, VOXEL_M));
    let found = search::search(&source, &target, prior, watch);
    if watch.interrupt().is_some() {
        return found;
    }
    let surfels = Surfels::new(Columns::new(&target, CELL_M));
    let source = Columns::new(&source, CELL_M).some_surfels(REFINED);
    Fit::new(&source, &surfels).run(&found, &REFINEMENT, watch)
}
