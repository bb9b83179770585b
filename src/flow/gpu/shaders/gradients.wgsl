// Weight gradients of one chunk of points: sums of activation x delta over its rows.
//
// In: activations, deltas, pulls, points. Out: one network's worth of partial gradients per chunk.
// A workgroup computes one layer (y: seven middle layers, then the first, then the last) of one
// chunk (x), adding its rows in order. step.wgsl adds the chunks in order. Without atomics the
// result is deterministic, and bit-identical to the CPU's, which sums in the same order. Mirrors
// ReferenceNetwork::backward.

// Whether only the first (y = 0) and the last layer are computed, because the matrix units compute
// the middle layers.
override OUTER = false;

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> points: array<f32>;
@group(0) @binding(1) var<storage, read> lanes: array<Lane>;
@group(0) @binding(2) var<storage, read> steps: array<Step>;
@group(0) @binding(3) var<storage, read> chunks: array<Chunk>;
@group(0) @binding(4) var<storage, read> statuses: array<Status>;
@group(0) @binding(5) var<storage, read> activations: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> deltas: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> pulls: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> partials: array<vec4<f32>>;

// Rows that are loaded together by an invocation with a single sum.
const ROWS = 8u;

@compute @workgroup_size(256)
fn gradients(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let chunk = chunks[part.first_chunk + group.x];
    if !iterates(statuses[chunk.lane], lanes[chunk.lane].steps, part.step) { return; }
    let slot = (part.first_chunk + group.x) * LAID_OUT;
    let layer = group.y + select(0u, MIDDLE_LAYERS, OUTER);
    switch layer {
        case 7u: { first_layer(chunk, slot, local); }
        case 8u: { last_layer(chunk, slot, local); }
        default: { middle_layer(layer, chunk, slot, local); }
    }
}

// 8 inputs x 8 outputs per invocation, in registers.
fn middle_layer(layer: u32, chunk: Chunk, slot: u32, local: u32) {
    let input = local / 16u;
    let output = local % 16u;
    let above = (layer * part.rows + chunk.first_row) * QUADS;
    let below = ((layer + 1u) * part.rows + chunk.first_row) * QUADS;
    // Products of four inputs with four outputs: inputs of the lower and of the upper half, each
    // with outputs of the lower and of the upper half.
    var low_low: array<vec4<f32>, 4>;
    var low_high: array<vec4<f32>, 4>;
    var high_low: array<vec4<f32>, 4>;
    var high_high: array<vec4<f32>, 4>;
    var bias_low = vec4(0.0);
    var bias_high = vec4(0.0);
    for (var row = 0u; row < chunk.rows; row++) {
        let h_low = activations[above + row * QUADS + input];
        let h_high = activations[above + row * QUADS + input + 16u];
        let d_low = deltas[below + row * QUADS + output];
        let d_high = deltas[below + row * QUADS + output + 16u];
        for (var i = 0u; i < 4u; i++) {
            low_low[i] = fma(vec4(h_low[i]), d_low, low_low[i]);
            low_high[i] = fma(vec4(h_low[i]), d_high, low_high[i]);
            high_low[i] = fma(vec4(h_high[i]), d_low, high_low[i]);
            high_high[i] = fma(vec4(h_high[i]), d_high, high_high[i]);
        }
        if input == 0u {
            bias_low += d_low;
            bias_high += d_high;
        }
    }
    let weights = slot + MIDDLE + layer * MIDDLE_STRIDE;
    let low = weights + output / 8u * 1024u + output % 8u;
    let high = low + 2048u;
    for (var i = 0u; i < 4u; i++) {
        let k_low = (input * 4u + i) * 8u;
        let k_high = k_low + 512u;
        partials[low + k_low] = low_low[i];
        partials[high + k_low] = low_high[i];
        partials[low + k_high] = high_low[i];
        partials[high + k_high] = high_high[i];
    }
    if input == 0u {
        partials[weights + MIDDLE_BIAS + output] = bias_low;
        partials[weights + MIDDLE_BIAS + output + 16u] = bias_high;
    }
}

// One sum per invocation: of delta times x, y, z or one, for four features.
fn first_layer(chunk: Chunk, slot: u32, local: u32) {
    let which = local / QUADS;
    let quad = local % QUADS;
    if which > 3u { return; }
    let step = steps[chunk.lane * STEPS + part.step];
    let batch = lanes[chunk.lane].points + step.first * 3u;
    let scale = lanes[chunk.lane].scale;
    let axis = min(which, 2u);
    let center = lanes[chunk.lane].center[axis];
    var sum = vec4(0.0);
    for (var row = 0u; row < chunk.rows; row += ROWS) {
        var factors: array<f32, ROWS>;
        var some: array<vec4<f32>, ROWS>;
        for (var i = 0u; i < ROWS; i++) {
            let point = min(chunk.first_point + row + i, step.count - 1u);
            let x = (points[batch + point * 3u + axis] - center) * scale;
            factors[i] = select(x, 1.0, which == 3u);
            some[i] = deltas[(chunk.first_row + row + i) * QUADS + quad];
        }
        for (var i = 0u; i < ROWS; i++) {
            sum = fma(vec4(factors[i]), some[i], sum);
        }
    }
    partials[slot + which * QUADS + quad] = sum;
}

// One sum per invocation: of x, y or z of the pull times four features, or of the pulls themselves.
fn last_layer(chunk: Chunk, slot: u32, local: u32) {
    let which = local / QUADS;
    let quad = local % QUADS;
    if which > 3u { return; }
    let above = (MIDDLE_LAYERS * part.rows + chunk.first_row) * QUADS + quad;
    var sum = vec4(0.0);
    for (var row = 0u; row < chunk.rows; row += ROWS) {
        var some: array<vec4<f32>, ROWS>;
        var features: array<vec4<f32>, ROWS>;
        for (var i = 0u; i < ROWS; i++) {
            some[i] = pulls[chunk.first_row + row + i];
            features[i] = activations[above + (row + i) * QUADS];
        }
        for (var i = 0u; i < ROWS; i++) {
            if which == 3u {
                sum += vec4(some[i].xyz, 0.0);
            } else {
                sum = fma(vec4(some[i][which]), features[i], sum);
            }
        }
    }
    if which < 3u {
        partials[slot + LAST + which * QUADS + quad] = sum;
    } else if quad == 0u {
        // The network's last vec4.
        partials[slot + LAST_BIAS] = sum;
    }
}
