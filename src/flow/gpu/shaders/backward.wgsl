// Backward pass: the derivative of the loss by every hidden feature, one tile of points per
// workgroup.
//
// In: pulls (the derivative of the loss by the flow, one per row), activations, transposed
// networks. Out: deltas, [layer][row][128]: the derivative by each hidden layer's features, zero
// where ReLU is inactive. Mirrors ReferenceNetwork::backward. Registers and memory as in
// forward.wgsl.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> networks: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> tiles: array<Tile>;
@group(0) @binding(2) var<storage, read> statuses: array<Status>;
@group(0) @binding(3) var<storage, read> pulls: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> activations: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> lanes: array<Lane>;
@group(0) @binding(6) var<storage, read_write> deltas: array<vec4<f32>>;

// Points of an invocation.
const OWN_POINTS = 4u;

var<workgroup> outputs: array<vec4<f32>, 2048>;

// Which of four features are active, four bits for each point of an invocation. They are read ahead of the
// stores: a load that follows a store to another buffer waits for it.
fn gates_of(layer: u32, row: u32, column: u32) -> u32 {
    var gates = 0u;
    for (var i = 0u; i < OWN_POINTS; i++) {
        let features = activations[(layer * part.rows + row + i) * QUADS + column];
        let bits = select(vec4(0u), vec4(1u, 2u, 4u, 8u), features > vec4(0.0));
        gates |= (bits.x | bits.y | bits.z | bits.w) << (4u * i);
    }
    return gates;
}

// Stores four of a row's derivatives, zero where the feature is inactive, and returns them.
fn gated(layer: u32, row: u32, column: u32, sum: vec4<f32>, gates: u32) -> vec4<f32> {
    let delta = select(vec4(0.0), sum, (vec4(gates) & vec4(1u, 2u, 4u, 8u)) != vec4(0u));
    deltas[(layer * part.rows + row) * QUADS + column] = delta;
    return delta;
}

@compute @workgroup_size(256)
fn backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let wave_tile = group.y * groups.x + group.x;
    if wave_tile >= part.tiles { return; }
    let work = tiles[part.first_tile + wave_tile];
    if !iterates(statuses[work.lane], lanes[work.lane].steps, part.step) { return; }
    let network = lanes[work.lane].network * ARRAYS * LAID_OUT;
    let row = wave_tile * TILE;
    let first = local / 16u * OWN_POINTS;
    let quad = local % 16u;

    // Sums for each of its points: derivatives by four of the lower 64 features and four of the
    // upper 64.
    var low: array<vec4<f32>, OWN_POINTS>;
    var high: array<vec4<f32>, OWN_POINTS>;
    {
        let at = network + LAST + quad;
        let x_low = networks[at];
        let y_low = networks[at + QUADS];
        let z_low = networks[at + 2u * QUADS];
        let x_high = networks[at + 16u];
        let y_high = networks[at + QUADS + 16u];
        let z_high = networks[at + 2u * QUADS + 16u];
        for (var i = 0u; i < OWN_POINTS; i++) {
            let pull = pulls[row + first + i];
            low[i] = fma(vec4(pull.x), x_low, fma(vec4(pull.y), y_low, pull.z * z_low));
            high[i] = fma(vec4(pull.x), x_high, fma(vec4(pull.y), y_high, pull.z * z_high));
        }
    }

    var gates_low = gates_of(MIDDLE_LAYERS, row + first, quad);
    var gates_high = gates_of(MIDDLE_LAYERS, row + first, quad + 16u);
    for (var done = 0u; done < MIDDLE_LAYERS; done++) {
        let layer = MIDDLE_LAYERS - done;
        let weights = network + TRANSPOSED * LAID_OUT + MIDDLE + (layer - 1u) * MIDDLE_STRIDE;
        workgroupBarrier();
        for (var i = 0u; i < OWN_POINTS; i++) {
            outputs[(first + i) * QUADS + quad] = gated(layer, row + first + i, quad, low[i], gates_low >> (4u * i));
            outputs[(first + i) * QUADS + quad + 16u] = gated(layer, row + first + i, quad + 16u, high[i], gates_high >> (4u * i));
            low[i] = vec4(0.0);
            high[i] = vec4(0.0);
        }
        workgroupBarrier();
        gates_low = gates_of(layer - 1u, row + first, quad);
        gates_high = gates_of(layer - 1u, row + first, quad + 16u);
        let at_low = weights + quad / 8u * 1024u + quad % 8u;
        let at_high = at_low + 2048u;
        // Weights are loaded while the products of those before are added.
        var next: array<vec4<f32>, 8>;
        for (var j = 0u; j < 4u; j++) {
            next[2u * j] = networks[at_low + j * 8u];
            next[2u * j + 1u] = networks[at_high + j * 8u];
        }
        for (var n = 0u; n < QUADS; n++) {
            let now = next;
            let ahead = min(n + 1u, QUADS - 1u) * 4u;
            for (var j = 0u; j < 4u; j++) {
                next[2u * j] = networks[at_low + (ahead + j) * 8u];
                next[2u * j + 1u] = networks[at_high + (ahead + j) * 8u];
            }
            var d: array<vec4<f32>, OWN_POINTS>;
            for (var i = 0u; i < OWN_POINTS; i++) {
                d[i] = outputs[(first + i) * QUADS + n];
            }
            for (var j = 0u; j < 4u; j++) {
                let w_low = now[2u * j];
                let w_high = now[2u * j + 1u];
                for (var i = 0u; i < OWN_POINTS; i++) {
                    low[i] = fma(vec4(d[i][j]), w_low, low[i]);
                    high[i] = fma(vec4(d[i][j]), w_high, high[i]);
                }
            }
        }
    }
    for (var i = 0u; i < OWN_POINTS; i++) {
        gated(0u, row + first + i, quad, low[i], gates_low >> (4u * i));
        gated(0u, row + first + i, quad + 16u, high[i], gates_high >> (4u * i));
    }
}
