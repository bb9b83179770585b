// Forward pass: flow = g(point), all layers, one tile of points per workgroup.
//
// In: points, networks. Out: one flow per row, metres. Unless EVALUATES, also the activations of
// the eight hidden layers, [layer][row][128]. Mirrors ReferenceNetwork::forward.
//
// An invocation holds 4 points x 8 features in registers. A layer's inputs are in workgroup memory.
// Its weights are read through the cache, four features at a time.

// Whether to evaluate the kept parameters, without storing activations for a backward pass.
override EVALUATES = false;

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> points: array<f32>;
@group(0) @binding(1) var<storage, read> networks: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> lanes: array<Lane>;
@group(0) @binding(3) var<storage, read> steps: array<Step>;
@group(0) @binding(4) var<storage, read> tiles: array<Tile>;
@group(0) @binding(5) var<storage, read> statuses: array<Status>;
@group(0) @binding(6) var<storage, read_write> flows: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> activations: array<vec4<f32>>;

// Points of an invocation.
const OWN_POINTS = 4u;

var<workgroup> inputs: array<vec4<f32>, 2048>;

// Index of four of a point's features. The exclusive or avoids bank conflicts between points.
fn slot(point: u32, column: u32) -> u32 {
    return point * QUADS + (column ^ (point % 8u));
}

// Stores four of a point's features for the next layer, and for the backward pass.
fn remember(layer: u32, row: u32, point: u32, column: u32, features: vec4<f32>) {
    inputs[slot(point, column)] = features;
    if !EVALUATES {
        activations[(layer * part.rows + row + point) * QUADS + column] = features;
    }
}

@compute @workgroup_size(256)
fn forward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let wave_tile = group.y * groups.x + group.x;
    if wave_tile >= part.tiles { return; }
    let work = tiles[part.first_tile + wave_tile];
    if !EVALUATES && !iterates(statuses[work.lane], lanes[work.lane].steps, part.step) { return; }
    let which = select(PARAMETERS, KEPT, EVALUATES);
    let network = (lanes[work.lane].network * ARRAYS + which) * LAID_OUT;
    let step = steps[work.lane * STEPS + part.step];
    let row = wave_tile * TILE;
    // This invocation's points, from `first`, and its features: four of each half.
    let first = local / 16u * OWN_POINTS;
    let quad = local % 16u;

    // Sums for each of its points: four of the lower 64 features and four of the upper 64.
    var low: array<vec4<f32>, OWN_POINTS>;
    var high: array<vec4<f32>, OWN_POINTS>;
    let scale = lanes[work.lane].scale;
    let center = vec3(lanes[work.lane].center[0], lanes[work.lane].center[1], lanes[work.lane].center[2]);
    {
        let at = network + quad;
        let x_low = networks[at];
        let y_low = networks[at + QUADS];
        let z_low = networks[at + 2u * QUADS];
        let bias_low = networks[at + FIRST_BIAS];
        let x_high = networks[at + 16u];
        let y_high = networks[at + QUADS + 16u];
        let z_high = networks[at + 2u * QUADS + 16u];
        let bias_high = networks[at + FIRST_BIAS + 16u];
        for (var i = 0u; i < OWN_POINTS; i++) {
            // Rows beyond the batch's end repeat its last point; their gradients are zero.
            let index = min(work.tile * TILE + first + i, step.count - 1u);
            let at = lanes[work.lane].points + (step.first + index) * 3u;
            let p = (vec3(points[at], points[at + 1u], points[at + 2u]) - center) * scale;
            low[i] = fma(vec4(p.z), z_low, fma(vec4(p.y), y_low, fma(vec4(p.x), x_low, bias_low)));
            high[i] = fma(vec4(p.z), z_high, fma(vec4(p.y), y_high, fma(vec4(p.x), x_high, bias_high)));
        }
    }

    for (var layer = 0u; layer < MIDDLE_LAYERS; layer++) {
        // Stores the features of this layer and initializes the sums of the next with its biases.
        let weights = network + MIDDLE + layer * MIDDLE_STRIDE;
        let bias_low = networks[weights + MIDDLE_BIAS + quad];
        let bias_high = networks[weights + MIDDLE_BIAS + quad + 16u];
        workgroupBarrier();
        for (var i = 0u; i < OWN_POINTS; i++) {
            remember(layer, row, first + i, quad, max(low[i], vec4(0.0)));
            remember(layer, row, first + i, quad + 16u, max(high[i], vec4(0.0)));
            low[i] = bias_low;
            high[i] = bias_high;
        }
        workgroupBarrier();
        // Weights are stored in panels of 32 features.
        let at_low = weights + quad / 8u * 1024u + quad % 8u;
        let at_high = at_low + 2048u;
        // Weights are loaded while the products of those before are added.
        var next: array<vec4<f32>, 8>;
        for (var j = 0u; j < 4u; j++) {
            next[2u * j] = networks[at_low + j * 8u];
            next[2u * j + 1u] = networks[at_high + j * 8u];
        }
        for (var k = 0u; k < QUADS; k++) {
            let now = next;
            let ahead = min(k + 1u, QUADS - 1u) * 4u;
            for (var j = 0u; j < 4u; j++) {
                next[2u * j] = networks[at_low + (ahead + j) * 8u];
                next[2u * j + 1u] = networks[at_high + (ahead + j) * 8u];
            }
            var h: array<vec4<f32>, OWN_POINTS>;
            for (var i = 0u; i < OWN_POINTS; i++) {
                h[i] = inputs[slot(first + i, k)];
            }
            for (var j = 0u; j < 4u; j++) {
                let w_low = now[2u * j];
                let w_high = now[2u * j + 1u];
                for (var i = 0u; i < OWN_POINTS; i++) {
                    low[i] = fma(vec4(h[i][j]), w_low, low[i]);
                    high[i] = fma(vec4(h[i][j]), w_high, high[i]);
                }
            }
        }
    }
    workgroupBarrier();
    for (var i = 0u; i < OWN_POINTS; i++) {
        remember(MIDDLE_LAYERS, row, first + i, quad, max(low[i], vec4(0.0)));
        remember(MIDDLE_LAYERS, row, first + i, quad + 16u, max(high[i], vec4(0.0)));
    }
    workgroupBarrier();

    // The last layer. Each output is summed in sixteen partial sums: four vec4s, by the index of
    // the feature's vec4 modulo 4. Two invocations of the first half share a point. The first one takes
    // vec4s 0 and 2, the second one 1 and 3, as in the fixed order of the reduction.
    let point = local / 2u % TILE;
    var sums: array<vec4<f32>, 3>;
    for (var output = 0u; output < 3u; output++) {
        let at = network + LAST + output * QUADS;
        var lower = vec4(0.0);
        var upper = vec4(0.0);
        for (var k = local % 2u; k < QUADS; k += 4u) {
            lower = fma(inputs[slot(point, k)], networks[at + k], lower);
            upper = fma(inputs[slot(point, k + 2u)], networks[at + k + 2u], upper);
        }
        sums[output] = lower + upper;
    }
    workgroupBarrier();
    if local < 2u * TILE {
        for (var output = 0u; output < 3u; output++) {
            inputs[local * 3u + output] = sums[output];
        }
    }
    workgroupBarrier();
    if local < TILE {
        let bias = networks[network + LAST_BIAS];
        var flow = vec4(0.0);
        for (var output = 0u; output < 3u; output++) {
            let four = inputs[local * 6u + output] + inputs[local * 6u + 3u + output];
            let two = four.xy + four.zw;
            flow[output] = (two.x + two.y) + bias[output];
        }
        flows[row + local] = flow;
    }
}
