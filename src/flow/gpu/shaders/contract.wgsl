// The product with the encoding of one axis of the linear model's grid: for each vertex the sum over
// the vertices on its line along the axis, in their order. Mirrors Encoder::apply.
//
// In: one float per vertex and axis of the flow. Out: the same. One of them per invocation.

struct Axis {
    // Floats from one vertex to the next along the axis, and from line to line within it.
    stride: u32,
    extent: u32,
    // Vertices along the axis, and floats of a row of the encoding.
    count: u32,
    pitch: u32,
    // The first float of the input.
    begin: u32,
}

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> statuses: array<Status>;
@group(0) @binding(2) var<storage, read> axes: array<Axis>;
@group(0) @binding(3) var<storage, read> encoding: array<f32>;
@group(0) @binding(4) var<storage, read> inputs: array<f32>;
@group(0) @binding(5) var<storage, read_write> outputs: array<f32>;

@compute @workgroup_size(64)
fn contract(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    if !iterates(statuses[0], lanes[0].steps, part.step) { return; }
    let at = (group.y * groups.x + group.x) * 64u + local;
    if at >= arrayLength(&outputs) { return; }
    let axis = axes[0];
    let along = at / axis.stride % axis.extent;
    var sum = 0.0;
    // The encoding is symmetric. The padding of rows is zero.
    if along < axis.count {
        let line = axis.begin + at - along * axis.stride;
        for (var i = 0u; i < axis.count; i++) {
            sum = fma(encoding[i * axis.pitch + along], inputs[line + i * axis.stride], sum);
        }
    }
    outputs[at] = sum;
}
