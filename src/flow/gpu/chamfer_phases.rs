//! The search of nearest neighbors for the Chamfer distance, bound to a submission.

use super::buffers::{Buffers, MOST_GROUPS, spread};
use super::context::Context;
use super::phase::{Dispatch, Phase};
use super::tiling::Wave;

/// Workgroups of a search with `tiles` tiles of queries. Each takes further tiles in turn.
pub(super) fn search_groups(tiles: usize) -> u32 {
    tiles.clamp(1, MOST_GROUPS as usize) as u32
}

/// The kernels of the search of nearest neighbors, bound to a submission's buffers.
pub(super) struct ChamferPhases<'a> {
    context: &'a Context,
    deform: wgpu::BindGroup,
    nearest: wgpu::BindGroup,
}

impl<'a> ChamferPhases<'a> {
    /// Binds the kernels.
    pub(super) fn bind(
        context: &'a Context,
        buffers: &Buffers,
        [tiles, flows]: [&wgpu::Buffer; 2],
    ) -> Self {
        let Buffers {
            store,
            lanes,
            steps,
            statuses,
            ..
        } = buffers;
        let kernels = &context.kernels;
        Self {
            context,
            deform: context.bound(
                &kernels.deform,
                &[store, lanes, steps, tiles, statuses, flows],
            ),
            nearest: context.bound(&kernels.nearest, &[store, lanes, steps, statuses]),
        }
    }

    /// The dispatch of [`Phase::Deform`] over a wave, or of [`Phase::Nearest`] over a wave of queries
    /// of each lane.
    pub(super) fn dispatch(&self, phase: Phase, wave: &Wave, lanes: u32) -> Dispatch<'_> {
        let kernels = &self.context.kernels;
        match phase {
            Phase::Deform => (&kernels.deform, &self.deform, spread(wave.tiles as u32)),
            _ => {
                // Both directions of each lane.
                let groups = [search_groups(wave.tiles), 2 * lanes];
                (&kernels.nearest, &self.nearest, groups)
            }
        }
    }
}
