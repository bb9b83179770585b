// The derivative of the loss by the displacements of the linear model's vertices: that of the points
// in the voxels around a vertex, and that of the total variation. One vertex per invocation.
//
// In: the pulls of the batch, the batch's voxels and points in ascending order, displacements and
// reciprocal lengths. Out: one float per vertex and axis of the flow. Mirrors Linear::level_gradient
// and Variation::add_gradient.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> steps: array<Step>;
@group(0) @binding(2) var<storage, read> statuses: array<Status>;
@group(0) @binding(3) var<storage, read> grids: array<Grid>;
@group(0) @binding(4) var<storage, read> placed: array<Placed>;
// Voxel and position of each point.
@group(0) @binding(5) var<storage, read> by_voxel: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read> pulls: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> values: array<f32>;
@group(0) @binding(8) var<storage, read> inverse_lengths: array<f32>;
@group(0) @binding(9) var<storage, read_write> value_gradients: array<f32>;

// The first of the batch's points whose voxel is not below `voxel`.
fn first_in(step: Step, voxel: u32) -> u32 {
    var low = step.first;
    var high = step.first + step.count;
    while low < high {
        let middle = (low + high) / 2u;
        if by_voxel[middle].x < voxel {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}

// The product of a difference of displacements with the reciprocal length at its lower vertex.
fn difference(at: u32, before: u32) -> f32 {
    return rounded((values[at] - values[before]) * inverse_lengths[before]);
}

@compute @workgroup_size(64)
fn vertex_gradients(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    if !iterates(statuses[0], lanes[0].steps, part.step) { return; }
    let grid = grids[0];
    let vertex = (group.y * groups.x + group.x) * 64u + local;
    if vertex >= grid.channel { return; }
    let step = steps[part.step];
    let x = vertex % grid.row;
    let y = vertex / grid.row % grid.vertices[1];
    let z = vertex / grid.plane;
    let inside = x < grid.vertices[0];
    var sum = vec3(0.0);
    // The voxels above the vertex, then those below it; each time those before it along y first.
    for (var below = 0u; below < 2u && inside; below++) {
        if z < below { continue; }
        for (var after = 0u; after < 2u; after++) {
            // The vertex is the upper one of the voxel along y, then the lower one.
            if y + after < 1u { continue; }
            let line = ((z - below) * grid.vertices[1] + y + after - 1u) * grid.vertices[0];
            let end = first_in(step, line + x + 1u);
            for (var at = first_in(step, line + max(x, 1u) - 1u); at < end; at++) {
                let entry = by_voxel[at];
                let own = placed[entry.y];
                let along = own.weights[select(0u, 1u, entry.x < line + x)];
                let weight = rounded(own.weights[3u - after] * along);
                let pull = rounded3(own.weights[4u + below] * pulls[entry.y - step.first].xyz);
                sum += rounded3(weight * pull);
            }
        }
    }
    for (var axis = 0u; axis < 3u; axis++) {
        let at = axis * grid.channel + vertex;
        var total = sum[axis];
        if grid.variation > 0.0 && inside {
            var varied = 0.0;
            if x > 0u { varied += difference(at, at - 1u); }
            if y > 0u { varied += difference(at, at - grid.row); }
            if z > 0u { varied += difference(at, at - grid.plane); }
            if x + 1u < grid.vertices[0] && y + 1u < grid.vertices[1] && z + 1u < grid.vertices[2] {
                let own = values[at];
                let ahead = (values[at + 1u] - own) + (values[at + grid.row] - own)
                    + (values[at + grid.plane] - own);
                varied -= rounded(ahead * inverse_lengths[at]);
            }
            total += rounded(grid.variation * varied);
        }
        value_gradients[at] = total;
    }
}
