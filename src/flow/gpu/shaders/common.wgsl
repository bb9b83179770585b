// What every kernel shares: sizes, and the records that the host writes (records.rs mirrors them).
// Records hold scalars alone, so that both sides agree on every offset.

// Features of a hidden layer, and the same in vec4s.
const WIDTH = 128u;
const QUADS = 32u;
// Layers from 128 to 128 features.
const MIDDLE_LAYERS = 7u;
// Points that one workgroup carries through the network.
const TILE = 64u;

// Places in a network's floats, in vec4s; field/mlp.rs lays them out.
const FIRST_BIAS = 96u;
const MIDDLE = 128u;
const MIDDLE_STRIDE = 4128u;
const MIDDLE_BIAS = 4096u;
const LAST = 29024u;
const LAST_BIAS = 29120u;
// A network's vec4s, and the arrays that a lane keeps of this size.
const LAID_OUT = 29124u;
const ARRAYS = 5u;
const PARAMETERS = 0u;
const TRANSPOSED = 1u;
const MEANS = 2u;
const SQUARES = 3u;
const KEPT = 4u;

// A target's distance transform: where it lies in the store, in words, and its geometry.
struct Transform {
    // The grid's first vertex, metres, as a sum of two floats an axis.
    origin_high: array<f32, 3>,
    origin_low: array<f32, 3>,
    inverse_cell: f32,
    // Metres of one code.
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

// One pair's optimization, in one submission.
struct Lane {
    transform: Transform,
    // Which of the card's networks it fits.
    network: u32,
    // Source points in the store, words.
    points: u32,
    // Its tiles and chunks among those of the submission.
    first_tile: u32,
    tiles: u32,
    first_chunk: u32,
    chunks: u32,
    // Network inputs: (point - center) * scale.
    center: array<f32, 3>,
    scale: f32,
    // The loss, see loss.rs.
    margin: f32,
    margin_slope: f32,
    truncation: f32,
    flow_penalty: f32,
    // 1 where the result is a running average, 0 where it is the best.
    average: u32,
    // The stopping rule; none where patience is 0.
    patience: u32,
    min_delta: f32,
    // Iterations that it has in this submission.
    steps: u32,
}

// One iteration of one lane.
struct Step {
    // The batch's points among the lane's.
    first: u32,
    count: u32,
    // One by the count.
    weight: f32,
    // Adam's factors.
    step_size: f32,
    square_correction: f32,
    // Weight of the present in a running average.
    fresh: f32,
}

// What one workgroup carries through the network: a tile of a lane's batch.
struct Tile {
    lane: u32,
    tile: u32,
}

// Points whose weight gradients are added up together: rows of the wave's activations.
struct Chunk {
    lane: u32,
    first_row: u32,
    rows: u32,
    // Its first point in the lane's batch.
    first_point: u32,
}

// How a lane's optimization stands.
struct Status {
    state: u32,
    iterations: u32,
    best_iteration: u32,
    best_loss: f32,
    // What the stopping rule has seen: whether anything, the best, and iterations since.
    seen: u32,
    seen_best: f32,
    without_progress: u32,
    // Whether this iteration's gradients are to be applied, and whether it is the best so far.
    applies: u32,
    improves: u32,
}

// Whether a lane has this iteration.
fn iterates(status: Status, lane_steps: u32, step: u32) -> bool {
    return status.state == RUNNING && step < lane_steps;
}

const RUNNING = 0u;
const CONVERGED = 1u;
const DIVERGED = 2u;

// Which part of the submission a dispatch does.
struct Part {
    // The iteration of this submission.
    step: u32,
    // The wave's first tile and chunk.
    first_tile: u32,
    first_chunk: u32,
    // The wave's tiles.
    tiles: u32,
    // Rows of a layer's activations.
    rows: u32,
    // Zero, which no compiler knows.
    nothing: u32,
}

// Steps that a submission may have.
const STEPS = 64u;
