// Nearest neighbors between the batch's displaced points and the target, by all distances.
//
// In: displaced points and target points. Out: the index of the nearest target point to each
// displaced point, and of the nearest displaced point to each target point. Workgroups with an even
// y do the former, those with an odd y the latter. Of equally near points it is the first. The sites
// pass through workgroup memory. An invocation has two queries and looks at every eighth site. The
// eight invocations of a query then compare what they found. Mirrors NearestKernel::search.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read_write> store: array<u32>;
@group(0) @binding(1) var<storage, read> lanes: array<Lane>;
@group(0) @binding(2) var<storage, read> steps: array<Step>;
@group(0) @binding(3) var<storage, read> statuses: array<Status>;

// Queries of a workgroup, and the invocations that share two of them.
const QUERIES = 64u;
const HALF = QUERIES / 2u;
const SHARES = 8u;
// Sites in workgroup memory at once.
const SITES = 1024u;
// Farther than any site.
const FAR = 0x1.fffffep+127f;

var<workgroup> sites: array<vec4<f32>, SITES>;
// The nearest site of each query in each share, and its squared distance.
var<workgroup> founds: array<u32, QUERIES * SHARES>;
var<workgroup> leasts: array<f32, QUERIES * SHARES>;

// A query's nearest site so far.
struct Nearest {
    found: u32,
    least: f32,
}

fn nearer(so_far: Nearest, query: vec3<f32>, site: vec3<f32>, index: u32) -> Nearest {
    let off = query - site;
    let square = fma(off.x, off.x, fma(off.y, off.y, fma(off.z, off.z, 0.0)));
    let is_nearer = square < so_far.least;
    return Nearest(select(so_far.found, index, is_nearer), select(so_far.least, square, is_nearer));
}

@compute @workgroup_size(256)
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
        let first_query = tile * QUERIES;
        let low_query = point_at(query_points, min(first_query + local % HALF, queries - 1u));
        let high_query = point_at(query_points, min(first_query + local % HALF + HALF, queries - 1u));
        var low = Nearest(0u, FAR);
        var high = Nearest(0u, FAR);
        for (var first = 0u; first < count; first += SITES) {
            workgroupBarrier();
            for (var i = local; i < SITES; i += HALF * SHARES) {
                sites[i] = vec4(point_at(site_points, min(first + i, count - 1u)), 0.0);
            }
            workgroupBarrier();
            let some = min(SITES, count - first);
            for (var i = local / HALF; i < some; i += SHARES) {
                let site = sites[i].xyz;
                low = nearer(low, low_query, site, first + i);
                high = nearer(high, high_query, site, first + i);
            }
        }
        let place = local / HALF * QUERIES + local % HALF;
        founds[place] = low.found;
        leasts[place] = low.least;
        founds[place + HALF] = high.found;
        leasts[place + HALF] = high.least;
        workgroupBarrier();
        if local < QUERIES && first_query + local < queries {
            var found = founds[local];
            var least = leasts[local];
            for (var share = 1u; share < SHARES; share++) {
                let other = founds[share * QUERIES + local];
                let square = leasts[share * QUERIES + local];
                if square < least || square == least && other < found {
                    found = other;
                    least = square;
                }
            }
            store[out + first_query + local] = found;
        }
    }
}
