// Weight gradients of one chunk of points for the middle layers, on the matrix units: sums of
// activation x delta over its rows.
//
// In: activations, deltas. Out: the middle layers' part of one network's worth of partial gradients
// per chunk. A workgroup computes one layer (y) of one chunk (x). Mirrors gradients.wgsl, which
// computes the first and the last layer, except for the rounding of both factors and the order of
// sums. Sums and biases are in single precision.
//
// A subgroup holds a piece of two by four tiles of the product. If there are fewer subgroups than
// pieces, the rows are read repeatedly. Deltas are multiplied by the batch's number of points
// before they are rounded, see backward_half.wgsl.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> steps: array<Step>;
@group(0) @binding(1) var<storage, read> chunks: array<Chunk>;
@group(0) @binding(2) var<storage, read> statuses: array<Status>;
@group(0) @binding(3) var<storage, read> activations: array<f32>;
@group(0) @binding(4) var<storage, read> deltas: array<f32>;
@group(0) @binding(5) var<storage, read> lanes: array<Lane>;
@group(0) @binding(6) var<storage, read_write> partials: array<f32>;

// Number of pieces across the outputs, and in total.
const PIECES_ACROSS = WIDTH / (4u * SIDE);
const PIECE_COUNT = WIDTH / (2u * SIDE) * PIECES_ACROSS;
// Outputs that are adjacent in a network's memory.
const PANEL = 32u;
// Invocations, and points whose features one of them loads at once: every second one.
const THREADS = 256u;
const OWN_POINTS = POINTS * WIDTH / THREADS;

var<workgroup> above: array<f16, 4352>;
var<workgroup> below: array<f16, 4352>;
var<workgroup> biases: array<f32, 256>;

// Index of a tile's first entry among a layer's floats.
fn panel_place(input: u32, output: u32) -> u32 {
    return (output / PANEL * WIDTH + input) * PANEL + output % PANEL;
}

@compute @workgroup_size(THREADS)
fn gradients_half(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(num_subgroups) subgroups: u32,
) {
    let layer = group.y;
    let chunk = chunks[part.first_chunk + group.x];
    // Not in a separate function: only in this form does the compiler recognize uniform control
    // flow.
    if statuses[chunk.lane].state != RUNNING { return; }
    if part.step >= lanes[chunk.lane].steps { return; }
    let count = f32(steps[chunk.lane * STEPS + part.step].count);
    let weights = ((part.first_chunk + group.x) * LAID_OUT + MIDDLE + layer * MIDDLE_STRIDE) * 4u;
    let feature = local % WIDTH;
    let upper = (layer * part.rows + chunk.first_row) * WIDTH + feature;
    let lower = ((layer + 1u) * part.rows + chunk.first_row) * WIDTH + feature;

    for (var first = 0u; first < PIECE_COUNT; first += subgroups) {
        let piece = first + subgroup;
        let input = piece / PIECES_ACROSS * 2u * SIDE;
        let output = piece % PIECES_ACROSS * 4u * SIDE;
        var s00 = Sums();
        var s01 = Sums();
        var s02 = Sums();
        var s03 = Sums();
        var s10 = Sums();
        var s11 = Sums();
        var s12 = Sums();
        var s13 = Sums();
        var bias = 0.0;
        // The next points are loaded while the products of these are added.
        var next_above: array<f32, OWN_POINTS>;
        var next_below: array<f32, OWN_POINTS>;
        for (var i = 0u; i < OWN_POINTS; i++) {
            let at = (local / WIDTH + 2u * i) * WIDTH;
            next_above[i] = activations[upper + at];
            next_below[i] = deltas[lower + at];
        }
        for (var row = 0u; row < chunk.rows; row += POINTS) {
            workgroupBarrier();
            for (var i = 0u; i < OWN_POINTS; i++) {
                let at = (local / WIDTH + 2u * i) * INPUT_PITCH + feature;
                bias += next_below[i];
                above[at] = halved(next_above[i]);
                below[at] = halved(next_below[i] * count);
            }
            workgroupBarrier();
            let next = min(row + POINTS, chunk.rows - POINTS);
            for (var i = 0u; i < OWN_POINTS; i++) {
                let at = (next + local / WIDTH + 2u * i) * WIDTH;
                next_above[i] = activations[upper + at];
                next_below[i] = deltas[lower + at];
            }
            if piece >= PIECE_COUNT { continue; }
            for (var k = 0u; k < POINTS; k += SIDE) {
                let at = k * INPUT_PITCH;
                let a0 = coopLoad<Left>(&above[at + input], INPUT_PITCH);
                let a1 = coopLoad<Left>(&above[at + input + SIDE], INPUT_PITCH);
                let b0 = coopLoadT<Right>(&below[at + output], INPUT_PITCH);
                let b1 = coopLoadT<Right>(&below[at + output + SIDE], INPUT_PITCH);
                let b2 = coopLoadT<Right>(&below[at + output + 2u * SIDE], INPUT_PITCH);
                let b3 = coopLoadT<Right>(&below[at + output + 3u * SIDE], INPUT_PITCH);
                s00 = coopMultiplyAdd(a0, b0, s00);
                s01 = coopMultiplyAdd(a0, b1, s01);
                s02 = coopMultiplyAdd(a0, b2, s02);
                s03 = coopMultiplyAdd(a0, b3, s03);
                s10 = coopMultiplyAdd(a1, b0, s10);
                s11 = coopMultiplyAdd(a1, b1, s11);
                s12 = coopMultiplyAdd(a1, b2, s12);
                s13 = coopMultiplyAdd(a1, b3, s13);
            }
        }
        if piece < PIECE_COUNT {
            let unscaled = 1.0 / count;
            coopStoreT(s00 * unscaled, &partials[weights + panel_place(input, output)], PANEL);
            coopStoreT(s01 * unscaled, &partials[weights + panel_place(input, output + SIDE)], PANEL);
            coopStoreT(s02 * unscaled, &partials[weights + panel_place(input, output + 2u * SIDE)], PANEL);
            coopStoreT(s03 * unscaled, &partials[weights + panel_place(input, output + 3u * SIDE)], PANEL);
            let next = input + SIDE;
            coopStoreT(s10 * unscaled, &partials[weights + panel_place(next, output)], PANEL);
            coopStoreT(s11 * unscaled, &partials[weights + panel_place(next, output + SIDE)], PANEL);
            coopStoreT(s12 * unscaled, &partials[weights + panel_place(next, output + 2u * SIDE)], PANEL);
            coopStoreT(s13 * unscaled, &partials[weights + panel_place(next, output + 3u * SIDE)], PANEL);
        }
        biases[local] = bias;
    }
    workgroupBarrier();
    if local < WIDTH {
        partials[weights + MIDDLE_BIAS * 4u + local] = biases[local] + biases[local + WIDTH];
    }
}
