// Rounds the middle layers' weights of a lane to halves, in blocks of 16 x 16. Each tile lies
// within one block. The forward pass reads the tiles as stored, the backward pass transposed.
//
// Four of one lane's (y) weights per invocation. In: networks. Out: halves, [lane][layer][input /
// 16][output / 16][16][16]. Runs before every iteration of a submission. The parameters themselves
// stay in single precision.

@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> statuses: array<Status>;
@group(0) @binding(2) var<storage, read> networks: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> halves: array<vec4<f16>>;

// vec4s of a layer's weights.
const LAYER_QUADS = 4096u;

@compute @workgroup_size(256)
fn halve(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
) {
    let lane = group.y;
    if statuses[lane].state != RUNNING { return; }
    let layer = id.x / LAYER_QUADS;
    let slot = id.x % LAYER_QUADS;
    let network = lanes[lane].network * ARRAYS * LAID_OUT;
    let weights = networks[network + MIDDLE + layer * MIDDLE_STRIDE + slot];
    // Panels of 32 outputs, see field/mlp.rs.
    let input = slot / 8u % WIDTH;
    let output = slot / 1024u * 32u + slot % 8u * 4u;
    let at = (lane * MIDDLE_LAYERS + layer) * LAYER_HALVES + tile_place(input, output);
    halves[at / 4u] = vec4(halved(weights.x), halved(weights.y), halved(weights.z), halved(weights.w));
}
