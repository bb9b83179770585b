// Sums the lengths of the total variation and writes the regularization to the lane's status, with
// one workgroup. Mirrors Linear::regularization.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> grids: array<Grid>;
@group(0) @binding(2) var<storage, read> terms: array<f32>;
@group(0) @binding(3) var<storage, read_write> statuses: array<Status>;

const THREADS = 256u;
var<workgroup> sums: array<f32, THREADS>;

@compute @workgroup_size(THREADS)
fn reduce_variation(@builtin(local_invocation_index) local: u32) {
    var sum = 0.0;
    for (var tile = local; tile < arrayLength(&terms); tile += THREADS) {
        sum += terms[tile];
    }
    sums[local] = sum;
    for (var stride = THREADS / 2u; stride > 0u; stride /= 2u) {
        workgroupBarrier();
        if local < stride {
            sums[local] += sums[local + stride];
        }
    }
    if local == 0u && iterates(statuses[0], lanes[0].steps, part.step) {
        statuses[0].regularization = rounded(grids[0].variation * sums[0]);
    }
}
