// Shared by all kernels: sizes, and the records that the host writes (gpu/layout.rs mirrors them).
// Records contain only scalars, so that both sides agree on all offsets.

// Features of a hidden layer, and the same in vec4s.
const WIDTH = 128u;
const QUADS = 32u;
// Layers from 128 to 128 features.
const MIDDLE_LAYERS = 7u;
// Points that one workgroup evaluates.
const TILE = 64u;

// Offsets in a network's floats, in vec4s; field/mlp.rs defines the layout.
const FIRST_BIAS = 96u;
const MIDDLE = 128u;
const MIDDLE_STRIDE = 4128u;
const MIDDLE_BIAS = 4096u;
const LAST = 29024u;
const LAST_BIAS = 29120u;
// Length of a network in vec4s, and the arrays of this length per lane.
const LAID_OUT = 29124u;
const ARRAYS = 5u;
const PARAMETERS = 0u;
const TRANSPOSED = 1u;
const MEANS = 2u;
const SQUARES = 3u;
const KEPT = 4u;

// A target's distance transform: offsets in the store, in words, and its geometry.
struct Transform {
    // The grid's first vertex, metres, as a sum of two floats per axis.
    origin_high: array<f32, 3>,
    origin_low: array<f32, 3>,
    inverse_cell: f32,
    // Metres per code.
    code_scale: f32,
    vertices: array<u32, 3>,
    blocks: array<u32, 3>,
    tables: u32,
    bricks: u32,
    codes: u32,
    far: u32,
    far_pitch: u32,
    far_vertices: array<u32, 3>,
}

// The clouds of a Chamfer distance in the store: offsets, in words, and the size of the target.
struct Cloud {
    target_points: u32,
    targets: u32,
    // The batch's displaced points.
    deformed: u32,
    // The target point nearest to each of them, and the one of them nearest to each target point.
    nearest: u32,
    sources: u32,
}

// The fit of one pair within one submission.
struct Lane {
    transform: Transform,
    cloud: Cloud,
    // Index of its arrays of parameters, and the length of one in vec4s.
    network: u32,
    parameters: u32,
    // Offset of the source points in the store, words.
    points: u32,
    // Its tiles and chunks among those of the submission.
    first_tile: u32,
    tiles: u32,
    first_chunk: u32,
    chunks: u32,
    // Network inputs: (point - center) * scale.
    center: array<f32, 3>,
    scale: f32,
    // Parameters of the loss, see field/loss.rs.
    margin: f32,
    margin_slope: f32,
    truncation: f32,
    flow_penalty: f32,
    // 1 if the result is a running average of the parameters, 0 if it is the best iteration.
    average: u32,
    // The stopping rule; disabled if patience is 0.
    patience: u32,
    min_delta: f32,
    // Number of iterations in this submission.
    steps: u32,
}

// One iteration of one lane.
struct Step {
    // The batch's first point among the lane's points, and its number of points.
    first: u32,
    count: u32,
    // 1 / count.
    weight: f32,
    // Factors of Adam's step.
    step_size: f32,
    square_correction: f32,
    // Weight of the new parameters in the running average.
    ema_weight: f32,
    // Points of the batch over points of the target.
    share: f32,
    // 1 if nearest neighbors are searched, 0 if those of an earlier iteration are kept.
    searches: u32,
}

// A tile of a lane's batch: the points of one workgroup.
struct Tile {
    lane: u32,
    tile: u32,
}

// A chunk: rows of the wave's activations whose weight gradients are summed together.
struct Chunk {
    lane: u32,
    first_row: u32,
    rows: u32,
    // Index of its first point in the lane's batch.
    first_point: u32,
}

// The state of a lane's optimization.
struct Status {
    state: u32,
    iterations: u32,
    best_iteration: u32,
    best_loss: f32,
    // State of the stopping rule: 1 after its first loss, its best loss, and iterations since then.
    seen: u32,
    seen_best: f32,
    without_progress: u32,
    // Whether this iteration's gradients are applied, and whether it is the best so far.
    applies: u32,
    improves: u32,
    // What the model adds to the mean loss of the points.
    regularization: f32,
}

// Whether the lane is running and has this iteration.
fn iterates(status: Status, lane_steps: u32, step: u32) -> bool {
    return status.state == RUNNING && step < lane_steps;
}

const RUNNING = 0u;
const CONVERGED = 1u;
const DIVERGED = 2u;

// The part of the submission that a dispatch processes.
struct Part {
    // Index of the iteration in this submission.
    step: u32,
    // The wave's first tile and first chunk.
    first_tile: u32,
    first_chunk: u32,
    // Number of tiles of the wave.
    tiles: u32,
    // Row of its first tile, for a kernel that works on pieces of waves.
    first_row: u32,
    // Number of rows of a layer's activations.
    rows: u32,
    // Always zero, which no compiler can assume; see arithmetic.wgsl.
    nothing: u32,
}

// Maximum number of iterations of a submission.
const STEPS = 64u;
