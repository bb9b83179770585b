// Transposes a lane's middle layers for the backward pass. Mirrors transpose_middle_layers: entry
// (output, input) of the result is entry (input, output) of the weights, both in panels of 32.
//
// A workgroup transposes one square of 32 x 32 floats (x) of one lane (y) in workgroup memory, so
// that reads and writes cover whole cache lines.

@group(0) @binding(0) var<storage, read> statuses: array<Status>;
@group(0) @binding(1) var<storage, read> lanes: array<Lane>;
@group(0) @binding(2) var<storage, read_write> networks: array<vec4<f32>>;

// One float of padding per row, to avoid bank conflicts when a column is read.
const ROW = 33u;
var<workgroup> square: array<f32, 1056>;

@compute @workgroup_size(256)
fn transpose(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let lane = group.y;
    if statuses[lane].applies == 0u { return; }
    let layer = group.x / 16u;
    let from_panel = group.x / 4u % 4u;
    let to_panel = group.x % 4u;
    let weights = lanes[lane].network * ARRAYS * LAID_OUT + MIDDLE + layer * MIDDLE_STRIDE;
    let input = local / 8u;
    let quad = local % 8u;
    let value = networks[weights + from_panel * 1024u + (to_panel * 32u + input) * 8u + quad];
    for (var i = 0u; i < 4u; i++) {
        square[input * ROW + quad * 4u + i] = value[i];
    }
    workgroupBarrier();
    let output = local / 8u;
    var turned: vec4<f32>;
    for (var i = 0u; i < 4u; i++) {
        turned[i] = square[(quad * 4u + i) * ROW + output];
    }
    let to = weights + TRANSPOSED * LAID_OUT;
    networks[to + to_panel * 1024u + (from_panel * 32u + output) * 8u + quad] = turned;
}
