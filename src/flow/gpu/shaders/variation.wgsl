// Total variation of the linear model's displacements: the length of their differences at each
// vertex.
//
// In: displacements of the vertices. Out: the reciprocal length at each vertex and axis of the flow,
// zero without a next neighbor along every axis, and each workgroup's sum of lengths. Mirrors
// Variation::measure.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> statuses: array<Status>;
@group(0) @binding(2) var<storage, read> grids: array<Grid>;
@group(0) @binding(3) var<storage, read> values: array<f32>;
@group(0) @binding(4) var<storage, read_write> inverse_lengths: array<f32>;
@group(0) @binding(5) var<storage, read_write> sums: array<f32>;

// Smoothing constant, square metres.
const SMOOTHING = 1e-5;

const TERMS = TILE;

@compute @workgroup_size(64)
fn variation(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    if !iterates(statuses[0], lanes[0].steps, part.step) { return; }
    let tile = group.y * groups.x + group.x;
    if tile >= arrayLength(&sums) { return; }
    let grid = grids[0];
    let at = tile * TILE + local;
    let along = at % grid.row;
    let across = at / grid.row % grid.vertices[1];
    let level = at / grid.plane % grid.vertices[2];
    var length = 0.0;
    if at < 3u * grid.channel {
        var inverse = 0.0;
        if along + 1u < grid.vertices[0] && across + 1u < grid.vertices[1] && level + 1u < grid.vertices[2] {
            let own = values[at];
            let ahead = vec3(values[at + 1u], values[at + grid.row], values[at + grid.plane]);
            let squares = rounded3((ahead - own) * (ahead - own));
            length = root(vec4(SMOOTHING + (squares.x + squares.y + squares.z))).x;
            inverse = quotient(vec4(1.0), vec4(length)).x;
        }
        inverse_lengths[at] = inverse;
    }
    let sum = tree_sum(local, length);
    if local == 0u {
        sums[tile] = sum;
    }
}
