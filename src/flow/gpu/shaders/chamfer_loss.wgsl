// Truncated Chamfer distance: the loss of every displaced point and its derivative by the flow, one
// tile per workgroup.
//
// In: points, flows, nearest neighbors. Out: pulls, the derivative of the batch's mean loss by each
// row's flow, zero beyond the batch's end; and each tile's sum of losses. A point's loss is that to
// its nearest target point, and then that to each target point that it is nearest to, in their
// order. Mirrors ChamferLoss::at.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> store: array<u32>;
@group(0) @binding(1) var<storage, read> lanes: array<Lane>;
@group(0) @binding(2) var<storage, read> steps: array<Step>;
@group(0) @binding(3) var<storage, read> tiles: array<Tile>;
@group(0) @binding(4) var<storage, read> statuses: array<Status>;
@group(0) @binding(5) var<storage, read> flows: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> pulls: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> tile_losses: array<f32>;

// Coordinates beyond this mean that a fit has diverged, metres.
const DIVERGED_M = 1e6;
// Target points that are looked at together, and by one invocation.
const SITES = 1024u;
const OWN_SITES = SITES / TILE;

// No point.
const NONE = 0xffffffffu;

const TERMS = TILE;

// Number of each invocation's target points to which a point of this tile is nearest, and all of
// these target points in their order, with the number of that point within the tile.
var<workgroup> counts: array<u32, TILE>;
var<workgroup> ours: array<vec4<f32>, SITES>;

// The squared distance (w) and its derivative (xyz), zero at and beyond the truncation.
fn squared(deformed: vec3<f32>, target_point: vec3<f32>, truncation: f32) -> vec4<f32> {
    let off = deformed - target_point;
    let squares = rounded3(off * off);
    let value = squares.x + squares.y + squares.z;
    if value >= rounded(truncation * truncation) { return vec4(0.0); }
    return vec4(2.0 * off, value);
}

@compute @workgroup_size(64)
fn chamfer_loss(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let wave_tile = group.y * groups.x + group.x;
    if wave_tile >= part.tiles { return; }
    let work = tiles[part.first_tile + wave_tile];
    if !iterates(statuses[work.lane], lanes[work.lane].steps, part.step) { return; }
    let step = steps[work.lane * STEPS + part.step];
    let cloud = lanes[work.lane].cloud;
    let truncation = lanes[work.lane].truncation;
    let row = part.first_row + wave_tile * TILE + local;
    let index = work.tile * TILE + local;
    let takes_part = index < step.count;
    var deformed = vec3(0.0);
    var sum = vec4(0.0);
    if takes_part {
        deformed = point_at(lanes[work.lane].points, step.first + index) + flows[row].xyz;
        sum = squared(deformed, point_at(cloud.target_points, store[cloud.nearest + index]), truncation);
    }
    for (var first = 0u; first < cloud.targets; first += SITES) {
        let own_first = first + local * OWN_SITES;
        var sources: array<u32, OWN_SITES>;
        var count = 0u;
        for (var i = 0u; i < OWN_SITES; i++) {
            sources[i] = store[cloud.sources + min(own_first + i, cloud.targets - 1u)];
            if own_first + i >= cloud.targets { sources[i] = NONE; }
            count += u32(sources[i] / TILE == work.tile);
        }
        workgroupBarrier();
        counts[local] = count;
        workgroupBarrier();
        var place = 0u;
        var total = 0u;
        for (var i = 0u; i < TILE; i++) {
            place += select(0u, counts[i], i < local);
            total += counts[i];
        }
        for (var i = 0u; i < OWN_SITES; i++) {
            if sources[i] / TILE == work.tile {
                let site = point_at(cloud.target_points, own_first + i);
                ours[place] = vec4(site, f32(sources[i] % TILE));
                place++;
            }
        }
        workgroupBarrier();
        for (var i = 0u; i < total; i++) {
            if ours[i].w == f32(local) {
                let own = squared(deformed, ours[i].xyz, truncation);
                sum += rounded4(step.share * own);
            }
        }
    }
    // Written so that a coordinate that is not a number counts as beyond it.
    if takes_part && step.searches == 1u && !all(abs(deformed) <= vec3(DIVERGED_M)) {
        sum = vec4(0.0, 0.0, 0.0, bitcast<f32>(0x7fc00000u ^ part.nothing));
    }
    pulls[row] = vec4(sum.xyz * step.weight, 0.0);
    let sum_of_losses = tree_sum(local, sum.w);
    if local == 0u {
        tile_losses[part.first_tile + wave_tile] = sum_of_losses;
    }
}
