// The derivative of the loss by every hidden feature, over one tile of points a workgroup.
//
// In: pulls (the derivative by the flow, a row each), activations, transposed networks.
// Out: deltas, [layer][row][128]: the derivative by each hidden layer's features, zero where ReLU
// cut them off. Mirrors ReferenceNetwork::backward. Registers and memory as in forward.wgsl.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> networks: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read> tiles: array<Tile>;
@group(0) @binding(2) var<storage, read> statuses: array<Status>;
@group(0) @binding(3) var<storage, read> pulls: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> activations: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> lanes: array<Lane>;
@group(0) @binding(6) var<storage, read_write> deltas: array<vec4<f32>>;

var<workgroup> outputs: array<vec4<f32>, 2048>;

// `delta` where the feature is on.
fn gated(delta: vec4<f32>, feature: vec4<f32>) -> vec4<f32> {
    return select(vec4(0.0), delta, feature > vec4(0.0));
}

@compute @workgroup_size(128)
fn backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let wave_tile = group.y * groups.x + group.x;
    if wave_tile >= part.tiles { return; }
    let work = tiles[part.first_tile + wave_tile];
    if statuses[work.lane].state != RUNNING { return; }
    let network = lanes[work.lane].network * ARRAYS * LAID_OUT;
    let row = wave_tile * TILE;
    let first = local / 16u * 8u;
    let quad = local % 16u;

    for (var side = 0u; side < 2u; side++) {
        let column = quad + side * 16u;
        let at = network + LAST + column;
        let w0 = networks[at];
        let w1 = networks[at + QUADS];
        let w2 = networks[at + 2u * QUADS];
        for (var i = 0u; i < 8u; i++) {
            let pull = pulls[row + first + i];
            let sum = fma(vec4(pull.x), w0, fma(vec4(pull.y), w1, pull.z * w2));
            let place = (MIDDLE_LAYERS * part.rows + row + first + i) * QUADS + column;
            let delta = gated(sum, activations[place]);
            deltas[place] = delta;
            outputs[(first + i) * QUADS + column] = delta;
        }
    }

    for (var done = 0u; done < MIDDLE_LAYERS; done++) {
        let layer = MIDDLE_LAYERS - 1u - done;
        let weights = network + TRANSPOSED * LAID_OUT + MIDDLE + layer * MIDDLE_STRIDE;
        var sums: array<vec4<f32>, 16>;
        workgroupBarrier();
        let low = weights + quad / 8u * 1024u + quad % 8u;
        let high = low + 2048u;
        for (var n = 0u; n < QUADS; n++) {
            var d: array<vec4<f32>, 8>;
            for (var i = 0u; i < 8u; i++) {
                d[i] = outputs[(first + i) * QUADS + n];
            }
            for (var j = 0u; j < 4u; j++) {
                let w_low = networks[low + (n * 4u + j) * 8u];
                let w_high = networks[high + (n * 4u + j) * 8u];
                for (var i = 0u; i < 8u; i++) {
                    sums[i * 2u] = fma(vec4(d[i][j]), w_low, sums[i * 2u]);
                    sums[i * 2u + 1u] = fma(vec4(d[i][j]), w_high, sums[i * 2u + 1u]);
                }
            }
        }
        workgroupBarrier();
        for (var i = 0u; i < 8u; i++) {
            for (var side = 0u; side < 2u; side++) {
                let column = quad + side * 16u;
                let place = (layer * part.rows + row + first + i) * QUADS + column;
                let delta = gated(sums[i * 2u + side], activations[place]);
                deltas[place] = delta;
                outputs[(first + i) * QUADS + column] = delta;
            }
        }
    }
}
