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

const THREADS = 128u;
// Rows that are loaded together, and vec4s of them that an invocation of a middle layer loads.
const ROWS = 8u;
const OWN_QUADS = ROWS * QUADS / THREADS;

// Activations and deltas of some rows of a middle layer.
var<workgroup> some_above: array<vec4<f32>, ROWS * QUADS>;
var<workgroup> some_below: array<vec4<f32>, ROWS * QUADS>;

@compute @workgroup_size(THREADS)
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

// 8 inputs x 16 outputs per invocation, in registers.
fn middle_layer(layer: u32, chunk: Chunk, slot: u32, local: u32) {
    let input = local / 8u;
    let output = local % 8u;
    let above = (layer * part.rows + chunk.first_row) * QUADS;
    let below = ((layer + 1u) * part.rows + chunk.first_row) * QUADS;
    // Products of eight inputs, four of the lower and four of the upper half, with four outputs of each
    // panel.
    var sums: array<array<vec4<f32>, 4>, 8>;
    var biases: array<vec4<f32>, 4>;
    // The next rows are loaded while the products of these are added.
    var next: array<vec4<f32>, 2u * OWN_QUADS>;
    for (var i = 0u; i < OWN_QUADS; i++) {
        next[i] = activations[above + local + i * THREADS];
        next[i + OWN_QUADS] = deltas[below + local + i * THREADS];
    }
    for (var first = 0u; first < chunk.rows; first += ROWS) {
        workgroupBarrier();
        for (var i = 0u; i < OWN_QUADS; i++) {
            some_above[local + i * THREADS] = next[i];
            some_below[local + i * THREADS] = next[i + OWN_QUADS];
        }
        workgroupBarrier();
        let at = min(first + ROWS, chunk.rows - ROWS) * QUADS + local;
        for (var i = 0u; i < OWN_QUADS; i++) {
            next[i] = activations[above + at + i * THREADS];
            next[i + OWN_QUADS] = deltas[below + at + i * THREADS];
        }
        for (var row = 0u; row < ROWS; row++) {
            let h_low = some_above[row * QUADS + input];
            let h_high = some_above[row * QUADS + input + 16u];
            for (var panel = 0u; panel < 4u; panel++) {
                let d = some_below[row * QUADS + output + panel * 8u];
                for (var i = 0u; i < 4u; i++) {
                    sums[i][panel] = fma(vec4(h_low[i]), d, sums[i][panel]);
                    sums[i + 4u][panel] = fma(vec4(h_high[i]), d, sums[i + 4u][panel]);
                }
                if input == 0u { biases[panel] += d; }
            }
        }
    }
    let weights = slot + MIDDLE + layer * MIDDLE_STRIDE;
    for (var panel = 0u; panel < 4u; panel++) {
        let at = weights + panel * 1024u + output;
        for (var i = 0u; i < 4u; i++) {
            let k = (input * 4u + i) * 8u;
            partials[at + k] = sums[i][panel];
            partials[at + k + 512u] = sums[i + 4u][panel];
        }
        if input == 0u { partials[weights + MIDDLE_BIAS + output + panel * 8u] = biases[panel]; }
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
