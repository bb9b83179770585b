// Sums the lengths of the total variation and writes the regularization to the lane's status, with
// one workgroup. Mirrors Linear::regularization.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> grids: array<Grid>;
@group(0) @binding(2) var<storage, read> tile_sums: array<f32>;
@group(0) @binding(3) var<storage, read_write> statuses: array<Status>;

const TERMS = 256u;

@compute @workgroup_size(TERMS)
fn reduce_variation(@builtin(local_invocation_index) local: u32) {
    var sum = 0.0;
    for (var tile = local; tile < arrayLength(&tile_sums); tile += TERMS) {
        sum += tile_sums[tile];
    }
    let all = tree_sum(local, sum);
    if local == 0u && iterates(statuses[0], lanes[0].steps, part.step) {
        statuses[0].regularization = rounded(grids[0].variation * all);
    }
}
