//! The records that host and kernels share; `shaders/common.wgsl` mirrors them, and a test compares
//! every offset. Scalars alone, so that both sides agree on every place. Computes nothing.

use bytemuck::{Pod, Zeroable};

/// Points that one workgroup carries through the network.
pub(super) const TILE: usize = 64;
/// Steps that a submission may have.
pub(super) const STEPS: usize = 64;
/// Arrays of a network's size that a lane keeps: parameters, transposes, Adam's two moments, and
/// the parameters of the result.
pub(super) const ARRAYS: usize = 5;

/// Where a transform lies in the store, in words, and its geometry.
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

/// One pair's optimization, in one submission.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Lane {
    pub(super) transform: Transform,
    pub(super) network: u32,
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
    pub(super) fresh: f32,
}

/// What one workgroup carries through the network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Tile {
    pub(super) lane: u32,
    pub(super) tile: u32,
}

/// Points whose weight gradients are added up together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Chunk {
    pub(super) lane: u32,
    pub(super) first_row: u32,
    pub(super) rows: u32,
    pub(super) first_point: u32,
}

/// How a lane's optimization stands.
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
}

/// [`Status::state`]: the stopping rule has fired.
pub(super) const CONVERGED: u32 = 1;
/// [`Status::state`]: a loss was not finite.
pub(super) const DIVERGED: u32 = 2;

/// Which part of the submission a dispatch does.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct Part {
    pub(super) step: u32,
    pub(super) first_tile: u32,
    pub(super) first_chunk: u32,
    pub(super) tiles: u32,
    pub(super) rows: u32,
    /// Zero, which no compiler of a kernel knows.
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
