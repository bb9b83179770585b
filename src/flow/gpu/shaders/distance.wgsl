// The distance transform at a point: trilinear interpolation and its gradient. Mirrors
// Bricks::sample. The host writes the store in gpu/distance.rs.

@group(0) @binding(0) var<storage, read> store: array<u32>;

const ABSENT = 0xffffffffu;
const BEYOND = 0xffffu;

struct Sample {
    distance: f32,
    gradient: vec3<f32>,
}

// Trilinear value (w) and its derivative by the fraction (xyz), from eight corners. Bits 4, 2 and 1
// of a corner's index are x, y and z.
fn trilinear(corners: array<f32, 8>, fraction: vec3<f32>) -> vec4<f32> {
    let low = vec4(corners[0], corners[2], corners[4], corners[6]);
    let slope_z = vec4(corners[1], corners[3], corners[5], corners[7]) - low;
    let along_z = low + rounded4(slope_z * fraction.z);
    let slope_y = along_z.yw - along_z.xz;
    let along_y = along_z.xz + rounded2(slope_y * fraction.y);
    let dx = along_y.y - along_y.x;
    let along_yz = slope_z.xz + rounded2((slope_z.yw - slope_z.xz) * fraction.y);
    // The derivatives by y and z and the value, interpolated along x.
    let begin = vec3(slope_y.x, along_yz.x, along_y.x);
    let slope = vec3(slope_y.y - slope_y.x, along_yz.y - along_yz.x, dx);
    let along_x = begin + rounded3(slope * fraction.x);
    return vec4(dx, along_x);
}

// Distance in the coarse field, metres (w), and its derivative by fine cells (xyz).
fn far_sample(transform: ptr<function, Transform>, corner: vec3<u32>, fraction: vec3<f32>) -> vec4<f32> {
    let pitch = (*transform).far_pitch;
    let scale = 1.0 / f32(pitch);
    let count = vec3((*transform).far_vertices[0], (*transform).far_vertices[1], (*transform).far_vertices[2]);
    let low = corner / pitch;
    let high = min(low + 1u, count - 1u);
    let within = (vec3<f32>(corner % pitch) + fraction) * scale;
    var corners: array<f32, 8>;
    for (var i = 0u; i < 8u; i++) {
        let at = select(low, high, vec3((i & 4u) != 0u, (i & 2u) != 0u, (i & 1u) != 0u));
        let slot = (at.x * count.y + at.y) * count.z + at.z;
        corners[i] = bitcast<f32>(store[(*transform).far + slot]);
    }
    let value = trilinear(corners, within);
    return vec4(value.xyz * scale, value.w);
}

// The code at a vertex: distance in units of code_scale, or BEYOND.
fn code_at(transform: ptr<function, Transform>, vertex: vec3<u32>) -> u32 {
    let block = vertex >> vec3(6u);
    let table = store[(*transform).tables
        + (block.x * (*transform).blocks[1] + block.y) * (*transform).blocks[2] + block.z];
    if table == ABSENT { return BEYOND; }
    let brick_in = (vertex >> vec3(3u)) & vec3(7u);
    let brick = store[(*transform).bricks + table * 512u + brick_in.x * 64u + brick_in.y * 8u + brick_in.z];
    if brick == ABSENT { return BEYOND; }
    let within = vertex & vec3(7u);
    let slot = within.x * 64u + within.y * 8u + within.z;
    let word = store[(*transform).codes + brick * 256u + slot / 2u];
    return (word >> ((slot & 1u) * 16u)) & 0xffffu;
}

fn sample(transform: ptr<function, Transform>, point: vec3<f32>) -> Sample {
    let high = vec3((*transform).origin_high[0], (*transform).origin_high[1], (*transform).origin_high[2]);
    let low = vec3((*transform).origin_low[0], (*transform).origin_low[1], (*transform).origin_low[2]);
    let count = vec3((*transform).vertices[0], (*transform).vertices[1], (*transform).vertices[2]);
    let at = rounded3(((point - high) - low) * (*transform).inverse_cell);
    let clipped = clamp(at, vec3(0.0), vec3<f32>(count - 1u));
    let inside = select(vec3(0.0), vec3((*transform).inverse_cell), clipped == at);
    let corner = min(vec3<u32>(clipped), count - 2u);
    let fraction = clipped - vec3<f32>(corner);

    var codes: array<u32, 8>;
    var near = 0u;
    for (var i = 0u; i < 8u; i++) {
        codes[i] = code_at(transform, corner + vec3(i >> 2u, (i >> 1u) & 1u, i & 1u));
        near += select(0u, 1u, codes[i] != BEYOND);
    }
    var value: vec4<f32>;
    if near == 0u {
        value = far_sample(transform, corner, fraction);
    } else {
        var corners: array<f32, 8>;
        for (var i = 0u; i < 8u; i++) {
            corners[i] = rounded(f32(codes[i]) * (*transform).code_scale);
            if codes[i] == BEYOND {
                let vertex = corner + vec3(i >> 2u, (i >> 1u) & 1u, i & 1u);
                corners[i] = far_sample(transform, vertex, vec3(0.0)).w;
            }
        }
        value = trilinear(corners, fraction);
    }
    return Sample(value.w, rounded3(value.xyz * inside));
}
