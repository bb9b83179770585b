// Backward pass in half precision: the derivative of the loss by every hidden feature, with the
// middle layers on the matrix units, half a tile of points per workgroup.
//
// In: pulls (the derivative of the loss by the flow, one per row), activations, networks, and the
// middle layers' weights as halves. Out: deltas, [layer][row][128]: the derivative by each hidden
// layer's features, zero where ReLU is inactive. Mirrors backward.wgsl except for the rounding of a
// middle layer's derivatives and weights.
//
// Pulls are the derivative of the batch's mean loss. They are multiplied by the batch's number of
// points before rounding, to avoid underflow of halves, and the stored deltas are divided by it. An
// invocation holds one feature of every point.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> networks: array<f32>;
@group(0) @binding(1) var<storage, read> tiles: array<Tile>;
@group(0) @binding(2) var<storage, read> statuses: array<Status>;
@group(0) @binding(3) var<storage, read> pulls: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> activations: array<f32>;
@group(0) @binding(5) var<storage, read> lanes: array<Lane>;
@group(0) @binding(6) var<storage, read> steps: array<Step>;
@group(0) @binding(7) var<storage, read> halves: array<f16>;
@group(0) @binding(8) var<storage, read_write> deltas: array<f32>;

// The tile of the right factor: the weights of the forward pass, transposed.
fn right(weights: u32, summed: u32, column: u32) -> Right {
    return coopLoad<Right>(&halves[weights + tile_place(column, summed)], BLOCK);
}

// Whether a feature is active, a bit for each point. They are read ahead of the stores: a load that
// follows a store to another buffer waits for it.
fn gates_of(layer: u32, row: u32, feature: u32) -> u32 {
    var gates = 0u;
    for (var point = 0u; point < POINTS; point++) {
        let slot = (layer * part.rows + row + point) * WIDTH + feature;
        gates |= select(0u, 1u << point, activations[slot] > 0.0);
    }
    return gates;
}

// Stores a point's derivative, zero where the feature is inactive, as input of the previous layer.
fn keep(layer: u32, row: u32, point: u32, feature: u32, sum: f32, unscaled: f32, gates: u32) {
    let delta = select(0.0, sum, (gates >> point & 1u) == 1u);
    inputs[point * INPUT_PITCH + feature] = halved(delta);
    deltas[(layer * part.rows + row + point) * WIDTH + feature] = delta * unscaled;
}

@compute @workgroup_size(128)
fn backward_half(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
    @builtin(subgroup_id) subgroup: u32,
    @builtin(num_subgroups) subgroups: u32,
) {
    let wave_half = group.y * groups.x + group.x;
    if wave_half >= part.tiles * 2u { return; }
    let work = tiles[part.first_tile + wave_half / 2u];
    // Not in a separate function: only in this form does the compiler recognize uniform control
    // flow.
    if statuses[work.lane].state != RUNNING { return; }
    if part.step >= lanes[work.lane].steps { return; }
    let network = lanes[work.lane].network * ARRAYS * LAID_OUT * 4u;
    let count = f32(steps[work.lane * STEPS + part.step].count);
    let unscaled = 1.0 / count;
    let row = wave_half * POINTS;
    var gates = gates_of(MIDDLE_LAYERS, row, local);

    {
        let at = network + LAST * 4u + local;
        let weights = vec3(networks[at], networks[at + WIDTH], networks[at + 2u * WIDTH]);
        for (var point = 0u; point < POINTS; point++) {
            let pull = pulls[row + point].xyz * count;
            let sum = fma(pull.x, weights.x, fma(pull.y, weights.y, pull.z * weights.z));
            keep(MIDDLE_LAYERS, row, point, local, sum, unscaled, gates);
        }
    }
    for (var done = 0u; done < MIDDLE_LAYERS; done++) {
        let layer = MIDDLE_LAYERS - 1u - done;
        workgroupBarrier();
        gates = gates_of(layer, row, local);
        multiply((work.lane * MIDDLE_LAYERS + layer) * LAYER_HALVES, subgroup, subgroups);
        workgroupBarrier();
        for (var point = 0u; point < POINTS; point++) {
            keep(layer, row, point, local, products[point * PRODUCT_PITCH + local], unscaled, gates);
        }
    }
}
