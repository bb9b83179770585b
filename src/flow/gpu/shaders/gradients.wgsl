// Weight gradients of one chunk of points: sums over its rows of activation x delta.
//
// In: activations, deltas, pulls, points. Out: one network's worth of partial gradients a chunk.
// A workgroup does one layer (y: seven middle ones, then the first, then the last) of one chunk
// (x); chunks are added up, in order, by step.wgsl: no atomics, the same bits every time.
// Mirrors ReferenceNetwork::backward.

// Whether the matrix units do the middle layers, and these are the first (y: 0) and the last.
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

// Rows that are added up side by side where a layer has one quad an invocation.
const GROUPS = 8u;
var<workgroup> groups: array<vec4<f32>, 256>;

@compute @workgroup_size(256)
fn gradients(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let chunk = chunks[part.first_chunk + group.x];
    if !iterates(statuses[chunk.lane], lanes[chunk.lane].steps, part.step) { return; }
    let place = (part.first_chunk + group.x) * LAID_OUT;
    let layer = group.y + select(0u, MIDDLE_LAYERS, OUTER);
    switch layer {
        case 7u: { first_layer(chunk, place, local); }
        case 8u: { last_layer(chunk, place, local); }
        default: { middle_layer(layer, chunk, place, local); }
    }
}

// 8 inputs x 8 outputs an invocation, in registers.
fn middle_layer(layer: u32, chunk: Chunk, place: u32, local: u32) {
    let input = local / 16u;
    let output = local % 16u;
    let above = (layer * part.rows + chunk.first_row) * QUADS;
    let below = ((layer + 1u) * part.rows + chunk.first_row) * QUADS;
    // Four inputs of the lower half by a quad of outputs of either half, and of the upper half.
    var low_low: array<vec4<f32>, 4>;
    var low_high: array<vec4<f32>, 4>;
    var high_low: array<vec4<f32>, 4>;
    var high_high: array<vec4<f32>, 4>;
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
    }
    let weights = place + MIDDLE + layer * MIDDLE_STRIDE;
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
    var bias = vec4(0.0);
    for (var row = local / QUADS; row < chunk.rows; row += GROUPS) {
        bias += deltas[below + row * QUADS + local % QUADS];
    }
    store(weights + MIDDLE_BIAS, bias, local);
}

// Adds up what the groups have for each quad, in order, and keeps it from `at` on.
fn store(at: u32, own: vec4<f32>, local: u32) {
    workgroupBarrier();
    groups[local] = own;
    workgroupBarrier();
    if local < QUADS {
        var sum = groups[local];
        for (var group = 1u; group < GROUPS; group++) {
            sum += groups[group * QUADS + local];
        }
        partials[at + local] = sum;
    }
}

fn first_layer(chunk: Chunk, place: u32, local: u32) {
    let step = steps[chunk.lane * STEPS + part.step];
    let batch = lanes[chunk.lane].points + step.first * 3u;
    let scale = lanes[chunk.lane].scale;
    let center = vec3(lanes[chunk.lane].center[0], lanes[chunk.lane].center[1], lanes[chunk.lane].center[2]);
    var sums: array<vec4<f32>, 4>;
    for (var row = local / QUADS; row < chunk.rows; row += GROUPS) {
        let at = batch + min(chunk.first_point + row, step.count - 1u) * 3u;
        let x = (vec3(points[at], points[at + 1u], points[at + 2u]) - center) * scale;
        let delta = deltas[(chunk.first_row + row) * QUADS + local % QUADS];
        sums[0] = fma(vec4(x.x), delta, sums[0]);
        sums[1] = fma(vec4(x.y), delta, sums[1]);
        sums[2] = fma(vec4(x.z), delta, sums[2]);
        sums[3] += delta;
    }
    for (var i = 0u; i < 4u; i++) {
        store(place + i * QUADS, sums[i], local);
    }
}

fn last_layer(chunk: Chunk, place: u32, local: u32) {
    var sums: array<vec4<f32>, 3>;
    var bias = vec4(0.0);
    for (var row = local / QUADS; row < chunk.rows; row += GROUPS) {
        let pull = pulls[chunk.first_row + row];
        let at = (MIDDLE_LAYERS * part.rows + chunk.first_row + row) * QUADS + local % QUADS;
        let h = activations[at];
        for (var i = 0u; i < 3u; i++) {
            sums[i] = fma(vec4(pull[i]), h, sums[i]);
        }
        bias += vec4(pull.xyz, 0.0);
    }
    for (var i = 0u; i < 3u; i++) {
        store(place + LAST + i * QUADS, sums[i], local);
    }
    // Every quad has the same bias: the first's is kept, in the network's last vec4.
    workgroupBarrier();
    groups[local] = bias;
    workgroupBarrier();
    if local == 0u {
        var sum = groups[0];
        for (var group = 1u; group < GROUPS; group++) {
            sum += groups[group * QUADS];
        }
        partials[place + LAST_BIAS] = sum;
    }
}
