// Nearest neighbors between the batch's displaced points and the target, by all distances.
//
// In: displaced points and target points. Out: the index of the nearest target point to each
// displaced point, and of the nearest displaced point to each target point. Workgroups with an even
// y do the former, those with an odd y the latter. Of equally near points it is the first. One query
// per invocation; the sites pass through workgroup memory. Mirrors NearestKernel::search.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read_write> store: array<u32>;
@group(0) @binding(1) var<storage, read> lanes: array<Lane>;
@group(0) @binding(2) var<storage, read> steps: array<Step>;
@group(0) @binding(3) var<storage, read> statuses: array<Status>;

const QUERIES = 64u;
// Sites in workgroup memory at once.
const SITES = 256u;
// Farther than any site.
const FAR = 0x1.fffffep+127f;

var<workgroup> sites: array<vec4<f32>, SITES>;

@compute @workgroup_size(64)
fn nearest(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let lane = group.y / 2u;
    if !iterates(statuses[lane], lanes[lane].steps, part.step) { return; }
    let step = steps[lane * STEPS + part.step];
    if step.searches == 0u { return; }
    let cloud = lanes[lane].cloud;
    let to_target = group.y % 2u == 0u;
    let queries = select(cloud.targets, step.count, to_target);
    let query_points = select(cloud.target_points, cloud.deformed, to_target);
    let count = select(step.count, cloud.targets, to_target);
    let site_points = select(cloud.deformed, cloud.target_points, to_target);
    let out = select(cloud.sources, cloud.nearest, to_target);
    // The tiles of this dispatch, which has one part of a long search.
    let end = min(part.first_tile + part.tiles, (queries + QUERIES - 1u) / QUERIES);
    for (var tile = part.first_tile + group.x; tile < end; tile += groups.x) {
        let index = tile * QUERIES + local;
        let query = point_at(query_points, min(index, queries - 1u));
        var found = 0u;
        var least = FAR;
        for (var first = 0u; first < count; first += SITES) {
            workgroupBarrier();
            for (var i = local; i < SITES; i += QUERIES) {
                sites[i] = vec4(point_at(site_points, min(first + i, count - 1u)), 0.0);
            }
            workgroupBarrier();
            let some = min(SITES, count - first);
            for (var i = 0u; i < some; i++) {
                let off = query - sites[i].xyz;
                let square = fma(off.x, off.x, fma(off.y, off.y, fma(off.z, off.z, 0.0)));
                let nearer = square < least;
                found = select(found, first + i, nearer);
                least = select(least, square, nearer);
            }
        }
        if index < queries {
            store[out + index] = found;
        }
    }
}
