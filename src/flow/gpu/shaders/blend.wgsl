// The linear model's flow: blended from the displacements of the 8 vertices around each point, one
// tile per workgroup. Mirrors Placed::blend.
//
// In: places of the points on the grid, displacements of the vertices. Out: one flow per row.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> steps: array<Step>;
@group(0) @binding(2) var<storage, read> statuses: array<Status>;
@group(0) @binding(3) var<storage, read> grids: array<Grid>;
@group(0) @binding(4) var<storage, read> placed: array<Placed>;
@group(0) @binding(5) var<storage, read> values: array<f32>;
@group(0) @binding(6) var<storage, read_write> flows: array<vec4<f32>>;

@compute @workgroup_size(64)
fn blend(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    if !iterates(statuses[0], lanes[0].steps, part.step) { return; }
    let step = steps[part.step];
    let index = (group.y * groups.x + group.x) * TILE + local;
    if index >= step.count { return; }
    let grid = grids[0];
    let own = placed[step.first + index];
    let first = own.cell[2] * grid.plane + own.cell[1] * grid.row + own.cell[0];
    var flow = vec4(0.0);
    for (var axis = 0u; axis < 3u; axis++) {
        var sum = 0.0;
        for (var up = 0u; up < 2u; up++) {
            for (var across = 0u; across < 2u; across++) {
                let at = axis * grid.channel + first + up * grid.plane + across * grid.row;
                let along = rounded(own.weights[0] * values[at]) + rounded(own.weights[1] * values[at + 1u]);
                sum += rounded(rounded(own.weights[4u + up] * own.weights[2u + across]) * along);
            }
        }
        flow[axis] = sum;
    }
    flows[index] = flow;
}
