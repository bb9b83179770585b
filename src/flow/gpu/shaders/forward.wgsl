// The network, all layers, over one tile of points a workgroup: flow = g(point).
//
// In: points, networks. Out: a flow a row, metres; and, unless it only evaluates, the activations
// of the eight hidden layers, [layer][row][128]. Mirrors ReferenceNetwork::forward.
//
// An invocation holds 8 points x 8 features in registers; a layer's inputs lie in workgroup memory,
// its weights stream from the cache, four features at a time.

// Whether the kept network is evaluated, and nothing is remembered for a backward pass.
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

var<workgroup> inputs: array<vec4<f32>, 2048>;

// Where a quad of a point's features lies: points side by side in different banks.
fn place(point: u32, column: u32) -> u32 {
    return point * QUADS + (column ^ (point % 8u));
}

// Keeps a quad of a point's features for the next layer, and for the backward pass.
fn remember(layer: u32, row: u32, point: u32, column: u32, features: vec4<f32>) {
    inputs[place(point, column)] = features;
    if !EVALUATES {
        activations[(layer * part.rows + row + point) * QUADS + column] = features;
    }
}

@compute @workgroup_size(128)
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
    // This invocation's points, from `first` on, and features: a quad of each half.
    let first = local / 16u * 8u;
    let quad = local % 16u;

    // Sums of the point's features: its quad of the lower half, and of the upper.
    var low: array<vec4<f32>, 8>;
    var high: array<vec4<f32>, 8>;
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
        for (var i = 0u; i < 8u; i++) {
            // Rows past the batch's end repeat its last point; their gradients are zero.
            let index = min(work.tile * TILE + first + i, step.count - 1u);
            let at = lanes[work.lane].points + (step.first + index) * 3u;
            let p = (vec3(points[at], points[at + 1u], points[at + 2u]) - center) * scale;
            low[i] = fma(vec4(p.z), z_low, fma(vec4(p.y), y_low, fma(vec4(p.x), x_low, bias_low)));
            high[i] = fma(vec4(p.z), z_high, fma(vec4(p.y), y_high, fma(vec4(p.x), x_high, bias_high)));
        }
    }

    for (var layer = 0u; layer < MIDDLE_LAYERS; layer++) {
        // The features of this layer, for all; and the sums of the next one's begin.
        let weights = network + MIDDLE + layer * MIDDLE_STRIDE;
        let bias_low = networks[weights + MIDDLE_BIAS + quad];
        let bias_high = networks[weights + MIDDLE_BIAS + quad + 16u];
        workgroupBarrier();
        for (var i = 0u; i < 8u; i++) {
            remember(layer, row, first + i, quad, max(low[i], vec4(0.0)));
            remember(layer, row, first + i, quad + 16u, max(high[i], vec4(0.0)));
            low[i] = bias_low;
            high[i] = bias_high;
        }
        workgroupBarrier();
        // Panels of 32 features.
        let at_low = weights + quad / 8u * 1024u + quad % 8u;
        let at_high = at_low + 2048u;
        for (var k = 0u; k < QUADS; k++) {
            var h: array<vec4<f32>, 8>;
            for (var i = 0u; i < 8u; i++) {
                h[i] = inputs[place(first + i, k)];
            }
            for (var j = 0u; j < 4u; j++) {
                let w_low = networks[at_low + (k * 4u + j) * 8u];
                let w_high = networks[at_high + (k * 4u + j) * 8u];
                for (var i = 0u; i < 8u; i++) {
                    low[i] = fma(vec4(h[i][j]), w_low, low[i]);
                    high[i] = fma(vec4(h[i][j]), w_high, high[i]);
                }
            }
        }
    }
    workgroupBarrier();
    for (var i = 0u; i < 8u; i++) {
        remember(MIDDLE_LAYERS, row, first + i, quad, max(low[i], vec4(0.0)));
        remember(MIDDLE_LAYERS, row, first + i, quad + 16u, max(high[i], vec4(0.0)));
    }
    workgroupBarrier();

    // Sixteen sums side by side, four quads of them: two invocations a point, the first of which
    // takes the first quad and the third, as they are added up.
    let point = local / 2u;
    var sums: array<vec4<f32>, 3>;
    for (var output = 0u; output < 3u; output++) {
        let at = network + LAST + output * QUADS;
        var lower = vec4(0.0);
        var upper = vec4(0.0);
        for (var k = local % 2u; k < QUADS; k += 4u) {
            lower = fma(inputs[place(point, k)], networks[at + k], lower);
            upper = fma(inputs[place(point, k + 2u)], networks[at + k + 2u], upper);
        }
        sums[output] = lower + upper;
    }
    workgroupBarrier();
    for (var output = 0u; output < 3u; output++) {
        inputs[local * 3u + output] = sums[output];
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
