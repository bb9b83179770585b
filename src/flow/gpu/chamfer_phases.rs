//! The search of nearest neighbors for the Chamfer distance, bound to a submission.

use super::buffers::{Buffers, spread};
use super::context::Context;
use super::phase::{Dispatch, Phase};
use super::tiling::Wave;

/// Queries per workgroup of `nearest.wgsl`.
const QUERY_GROUP: usize = 64;
/// The most workgroups of a search along one dimension. Each takes further queries in turn.
const MOST_GROUPS: usize = 65_535;

/// Workgroups of a search with `queries` queries.
pub(super) fn search_groups(queries: usize) -> u32 {
    queries.div_ceil(QUERY_GROUP).clamp(1, MOST_GROUPS) as u32
}

/// The kernels of the search of nearest neighbors, bound to a submission's buffers.
pub(super) struct ChamferPhases<'a> {
    context: &'a Context,
    deform: wgpu::BindGroup,
    nearest: wgpu::BindGroup,
    groups: u32,
}

impl<'a> ChamferPhases<'a> {
    /// Binds the kernels, where the largest search has `queries` queries.
    pub(super) fn bind(
        context: &'a Context,
        buffers: &Buffers,
        [tiles, flows]: [&wgpu::Buffer; 2],
        queries: usize,
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
            groups: search_groups(queries),
        }
    }

    /// The dispatch of [`Phase::Deform`] over a wave, or of [`Phase::Nearest`] over all lanes.
    pub(super) fn dispatch(&self, phase: Phase, wave: &Wave, lanes: u32) -> Dispatch<'_> {
        let kernels = &self.context.kernels;
        match phase {
            Phase::Deform => (&kernels.deform, &self.deform, spread(wave.tiles as u32)),
            // Both directions of each lane.
            _ => (&kernels.nearest, &self.nearest, [self.groups, 2 * lanes]),
        }
    }
}
