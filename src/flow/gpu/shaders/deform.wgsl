// The batch's displaced points, for the search of nearest neighbors.
//
// In: points, flows. Out: the displaced points of the batch, in the store. One tile per workgroup.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read_write> store: array<u32>;
@group(0) @binding(1) var<storage, read> lanes: array<Lane>;
@group(0) @binding(2) var<storage, read> steps: array<Step>;
@group(0) @binding(3) var<storage, read> tiles: array<Tile>;
@group(0) @binding(4) var<storage, read> statuses: array<Status>;
@group(0) @binding(5) var<storage, read> flows: array<vec4<f32>>;

@compute @workgroup_size(64)
fn deform(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let wave_tile = group.y * groups.x + group.x;
    if wave_tile >= part.tiles { return; }
    let work = tiles[part.first_tile + wave_tile];
    if !iterates(statuses[work.lane], lanes[work.lane].steps, part.step) { return; }
    let step = steps[work.lane * STEPS + part.step];
    let index = work.tile * TILE + local;
    if index >= step.count { return; }
    let flow = flows[wave_tile * TILE + local].xyz;
    let begin = lanes[work.lane].points + (step.first + index) * 3u;
    let to = lanes[work.lane].cloud.deformed + index * 3u;
    for (var axis = 0u; axis < 3u; axis++) {
        store[to + axis] = bitcast<u32>(bitcast<f32>(store[begin + axis]) + flow[axis]);
    }
}
