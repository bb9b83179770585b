// The distance transform at arbitrary points: gradient (xyz) and distance (w).
//
// In: points, metres, three floats each. Out: one vec4 per point: gradient in metres per metre,
// distance in metres. Mirrors Bricks::sample.

var<immediate> part: Part;
@group(0) @binding(1) var<storage, read> points: array<f32>;
@group(0) @binding(2) var<storage, read> transforms: array<Transform>;
@group(0) @binding(3) var<storage, read_write> samples: array<vec4<f32>>;

@compute @workgroup_size(64)
fn sample_points(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let index = id.y * groups.x * 64u + id.x;
    if index >= arrayLength(&points) / 3u { return; }
    var transform = transforms[0];
    let point = vec3(points[index * 3u], points[index * 3u + 1u], points[index * 3u + 2u]);
    let seen = sample(&transform, point);
    samples[index] = vec4(seen.gradient, seen.distance);
}
