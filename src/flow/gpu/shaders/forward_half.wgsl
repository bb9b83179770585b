// Forward pass in half precision: flow = g(point), with the middle layers on the matrix units, half
// a tile of points per workgroup.
//
// In: points, networks, and the middle layers' weights as halves. Out: one flow per row, metres,
// and the activations of the eight hidden layers, [layer][row][128]. Mirrors forward.wgsl except
// for the rounding of a middle layer's inputs and weights and the order of sums. Sums, the first
// and the last layer are in single precision.
//
// An invocation holds one feature of every point, except in the products and the last layer.
// Activations are stored in single precision, so that all other kernels are the same for both
// precisions. Stored as halves they would halve the memory traffic, which limits this kernel on a
// large GPU.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> points: array<f32>;
@group(0) @binding(1) var<storage, read> networks: array<f32>;
@group(0) @binding(2) var<storage, read> lanes: array<Lane>;
@group(0) @binding(3) var<storage, read> steps: array<Step>;
@group(0) @binding(4) var<storage, read> tiles: array<Tile>;
@group(0) @binding(5) var<storage, read> statuses: array<Status>;
@group(0) @binding(6) var<storage, read> halves: array<f16>;
@group(0) @binding(7) var<storage, read_write> flows: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> activations: array<f32>;

// The tile of the right factor: weights, from the inputs `summed` to the outputs `column`.
fn right(weights: u32, summed: u32, column: u32) -> Right {
    return coopLoadT<Right>(&halves[weights + tile_place(summed, column)], BLOCK);
}

@compute @workgroup_size(128)
fn forward_half(
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
    let step = steps[work.lane * STEPS + part.step];
    let row = wave_half * POINTS;
    let first_point = work.tile * TILE + wave_half % 2u * POINTS;

    {
        let scale = lanes[work.lane].scale;
        let center = vec3(lanes[work.lane].center[0], lanes[work.lane].center[1], lanes[work.lane].center[2]);
        let at = network + local;
        let weights = vec3(networks[at], networks[at + WIDTH], networks[at + 2u * WIDTH]);
        let bias = networks[at + FIRST_BIAS * 4u];
        for (var point = 0u; point < POINTS; point++) {
            // Rows beyond the batch's end repeat its last point; their gradients are zero.
            let index = min(first_point + point, step.count - 1u);
            let at = lanes[work.lane].points + (step.first + index) * 3u;
            let p = (vec3(points[at], points[at + 1u], points[at + 2u]) - center) * scale;
            let sum = fma(p.z, weights.z, fma(p.y, weights.y, fma(p.x, weights.x, bias)));
            let feature = max(sum, 0.0);
            inputs[point * INPUT_PITCH + local] = halved(feature);
            activations[(row + point) * WIDTH + local] = feature;
        }
    }

    for (var layer = 0u; layer < MIDDLE_LAYERS; layer++) {
        workgroupBarrier();
        multiply((work.lane * MIDDLE_LAYERS + layer) * LAYER_HALVES, subgroup, subgroups);
        workgroupBarrier();
        let weights = MIDDLE + layer * MIDDLE_STRIDE;
        let bias = networks[network + (weights + MIDDLE_BIAS) * 4u + local];
        for (var point = 0u; point < POINTS; point++) {
            let feature = max(products[point * PRODUCT_PITCH + local] + bias, 0.0);
            products[point * PRODUCT_PITCH + local] = feature;
            inputs[point * INPUT_PITCH + local] = halved(feature);
            activations[((layer + 1u) * part.rows + row + point) * WIDTH + local] = feature;
        }
    }
    workgroupBarrier();

    // The last layer: one axis of a point's flow per invocation. The fourth invocation of each
    // point writes zero.
    let point = local / 4u;
    let axis = min(local % 4u, 2u);
    let weights = network + LAST * 4u + axis * WIDTH;
    var flow = networks[network + LAST_BIAS * 4u + axis];
    for (var k = 0u; k < WIDTH; k++) {
        flow = fma(products[point * PRODUCT_PITCH + k], networks[weights + k], flow);
    }
    flows[row + point][local % 4u] = select(flow, 0.0, local % 4u == 3u);
}
