// Distance query: the loss of every deformed point and its derivative by the flow, one tile per
// workgroup.
//
// In: points, flows. Out: pulls, the derivative of the batch's mean loss by each row's flow, zero
// beyond the batch's end; and each tile's sum of losses. Mirrors LossOptions::at.

var<immediate> part: Part;
@group(0) @binding(1) var<storage, read> lanes: array<Lane>;
@group(0) @binding(2) var<storage, read> steps: array<Step>;
@group(0) @binding(3) var<storage, read> tiles: array<Tile>;
@group(0) @binding(4) var<storage, read> statuses: array<Status>;
@group(0) @binding(5) var<storage, read> flows: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> pulls: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> tile_losses: array<f32>;

// Flows shorter than this are penalized quadratically, metres.
const SMALL_FLOW = 1e-3;

const TERMS = TILE;

@compute @workgroup_size(64)
fn distance_loss(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let wave_tile = group.y * groups.x + group.x;
    if wave_tile >= part.tiles { return; }
    let work = tiles[part.first_tile + wave_tile];
    if !iterates(statuses[work.lane], lanes[work.lane].steps, part.step) { return; }
    let step = steps[work.lane * STEPS + part.step];
    let row = wave_tile * TILE + local;
    let index = work.tile * TILE + local;
    var pull = vec3(0.0);
    var loss = 0.0;
    if index < step.count {
        let at = lanes[work.lane].points + (step.first + index) * 3u;
        let point = bitcast<vec3<f32>>(vec3(store[at], store[at + 1u], store[at + 2u]));
        let flow = flows[row].xyz;
        var transform = lanes[work.lane].transform;
        let seen = sample(&transform, point + flow);
        let truncation = lanes[work.lane].truncation;
        let margin = max(lanes[work.lane].margin, lanes[work.lane].margin_slope * long(point));
        let penalty = lanes[work.lane].flow_penalty;
        let flow_m = long(flow);
        if seen.distance > margin && seen.distance < truncation {
            pull = seen.gradient;
        }
        let shrink = quotient(vec4(penalty), vec4(max(flow_m, SMALL_FLOW))).x;
        pull = (pull + rounded3(shrink * flow)) * step.weight;
        let square = vec4(rounded(flow_m * flow_m));
        let short = quotient(square, vec4(2.0 * SMALL_FLOW)).x;
        let penalized = select(short, flow_m - SMALL_FLOW / 2.0, flow_m > SMALL_FLOW);
        loss = min(max(seen.distance, margin), truncation) + rounded(penalty * penalized);
    }
    pulls[row] = vec4(pull, 0.0);
    let sum_of_losses = tree_sum(local, loss);
    if local == 0u {
        tile_losses[part.first_tile + wave_tile] = sum_of_losses;
    }
}
