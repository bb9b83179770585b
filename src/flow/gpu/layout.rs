//! The records that host and kernels share. `shaders/common.wgsl` mirrors them, and a test compares
//! all offsets. Records contain only scalars, so that both sides agree on all offsets.

use bytemuck::{Pod, Zeroable};

use crate::flow::field::{Parameters, TrainerState};

/// Points that one workgroup evaluates.
pub(super) const TILE: usize = 64;
/// Maximum number of iterations of a submission.
pub(super) const STEPS: usize = 64;
/// Number of arrays of a network's size per lane: parameters, transposed weights, Adam's two
/// moments, and the parameters of the result.
pub(super) const ARRAYS: usize = 5;

/// Indices of a lane's arrays; common.wgsl has the same.
pub(super) const PARAMETERS: u64 = 0;
pub(super) const TRANSPOSED: u64 = 1;
pub(super) const MEANS: u64 = 2;
pub(super) const SQUARES: u64 = 3;
pub(super) const KEPT: u64 = 4;

/// The arrays of a fit's state, each with its index.
pub(super) struct Arrays<'a>(pub(super) [(u64, &'a Parameters); 4]);

impl<'a> Arrays<'a> {
    /// Those of `state`.
    pub(super) fn of(state: &'a TrainerState) -> Self {
        let [means, squares] = &state.moments;
        Self([
            (PARAMETERS, &state.parameters),
            (MEANS, means),
            (SQUARES, squares),
            (KEPT, &state.kept),
        ])
    }

    /// The parameters.
    pub(super) fn parameters(&self) -> &'a Parameters {
        self.0[0].1
    }
}

/// Offsets of a distance transform in the store, in 32-bit words, and its geometry.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Transform {
    pub(super) origin_high: [f32; 3],
    pub(super) origin_low: [f32; 3],
    pub(super) inverse_cell: f32,
    pub(super) code_scale: f32,
    pub(super) vertices: [u32; 3],
    pub(super) blocks: [u32; 3],
    pub(super) tables: u32,
    pub(super) bricks: u32,
    pub(super) codes: u32,
    pub(super) far: u32,
    pub(super) far_pitch: u32,
    pub(super) far_vertices: [u32; 3],
}

/// The clouds of a Chamfer distance: offsets in the store, in 32-bit words, and the target's size.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Cloud {
    pub(super) target_points: u32,
    pub(super) targets: u32,
    pub(super) deformed: u32,
    pub(super) nearest: u32,
    pub(super) sources: u32,
}

/// The grid of a linear model: `Grid` of `shaders/grid.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Grid {
    pub(super) vertices: [u32; 3],
    pub(super) row: u32,
    pub(super) plane: u32,
    pub(super) channel: u32,
    pub(super) variation: f32,
}

/// A point on that grid: `Placed` of `shaders/grid.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Placed {
    pub(super) cell: [u32; 3],
    pub(super) weights: [f32; 6],
}

/// An axis of that grid: `Axis` of `shaders/contract.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Axis {
    pub(super) stride: u32,
    pub(super) extent: u32,
    pub(super) count: u32,
    pub(super) pitch: u32,
    pub(super) begin: u32,
}

/// The fit of one pair within one submission.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Lane {
    pub(super) transform: Transform,
    pub(super) cloud: Cloud,
    pub(super) network: u32,
    pub(super) parameters: u32,
    pub(super) points: u32,
    pub(super) first_tile: u32,
    pub(super) tiles: u32,
    pub(super) first_chunk: u32,
    pub(super) chunks: u32,
    pub(super) center: [f32; 3],
    pub(super) scale: f32,
    pub(super) margin: f32,
    pub(super) margin_slope: f32,
    pub(super) truncation: f32,
    pub(super) flow_penalty: f32,
    pub(super) average: u32,
    pub(super) patience: u32,
    pub(super) min_delta: f32,
    pub(super) steps: u32,
}

/// One iteration of one lane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Step {
    pub(super) first: u32,
    pub(super) count: u32,
    pub(super) weight: f32,
    pub(super) step_size: f32,
    pub(super) square_correction: f32,
    pub(super) ema_weight: f32,
    pub(super) share: f32,
    pub(super) searches: u32,
}

/// A tile: the points of one workgroup.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Tile {
    pub(super) lane: u32,
    pub(super) tile: u32,
}

/// A chunk: consecutive points whose weight gradients are summed by one workgroup per layer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Chunk {
    pub(super) lane: u32,
    pub(super) first_row: u32,
    pub(super) rows: u32,
    pub(super) first_point: u32,
}

/// The state of a lane's optimization.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Status {
    pub(super) state: u32,
    pub(super) iterations: u32,
    pub(super) best_iteration: u32,
    pub(super) best_loss: f32,
    pub(super) seen: u32,
    pub(super) seen_best: f32,
    pub(super) without_progress: u32,
    pub(super) applies: u32,
    pub(super) improves: u32,
    pub(super) regularization: f32,
}

/// [`Status::state`]: the stopping rule has fired.
pub(super) const CONVERGED: u32 = 1;
/// [`Status::state`]: a loss was not finite.
pub(super) const DIVERGED: u32 = 2;

/// The part of the submission that a dispatch processes.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Part {
    pub(super) step: u32,
    pub(super) first_tile: u32,
    pub(super) first_chunk: u32,
    pub(super) tiles: u32,
    pub(super) first_row: u32,
    pub(super) rows: u32,
    /// Always zero. The shader compilers cannot assume so, see `arithmetic.wgsl`.
    pub(super) nothing: u32,
}

/// How a transform's bricks are filled: `Plan` of `shaders/bricks.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct BrickPlan {
    pub(super) band: i32,
    pub(super) rows: u32,
    pub(super) bricks: u32,
    pub(super) codes: u32,
}

/// A column of occupied vertices: `Column` of `shaders/bricks.wgsl`.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Column {
    pub(super) y: i32,
    pub(super) layer: u32,
    pub(super) squares: u32,
}
