// The normals of the target points: mirrors TargetCloud::find_normals and the plane of Neighborhood. One
// invocation fits the plane around one point of one view.

@group(0) @binding(4) var<storage, read_write> normals: array<vec4<f32>>;

// Least number of points of a plane, its center included.
const LEAST_POINTS = 4.0;
// Flatness threshold.
const FLAT = 0.05;
// Variances below this count as zero, square metres.
const NO_SPREAD = 1e-12;
const THIRD_OF_A_TURN = 2.0943951;

// Sums over the points around a center, of their offsets and of the products of these.
struct Neighborhood {
    count: f32,
    sum: vec3<f32>,
    // xx, yy and zz.
    squares: vec3<f32>,
    // xy, xz and yz.
    products: vec3<f32>,
}

// Adds the points of an index that are less than `within_m` metres from `center`. Their positions are
// in `points` from `targets` on.
fn add_near(
    index: Index,
    targets: u32,
    center: vec3<f32>,
    within_m: f32,
    near: ptr<function, Neighborhood>,
) {
    var walk = begin_walk(index, center.xy, within_m);
    while next_run(index, &walk) {
        for (var slot = walk.begin; slot < walk.end; slot++) {
            let away = center - points[targets + slot].xyz;
            if dot(away, away) < within_m * within_m {
                (*near).count += 1.0;
                (*near).sum += away;
                (*near).squares += away * away;
                (*near).products += away.xxy * away.yzz;
            }
        }
    }
}

// The longest cross product of two columns of a symmetric matrix with `least` subtracted from its
// diagonal: its eigenvector, if `least` is its eigenvalue.
fn eigenvector(diagonal: vec3<f32>, beside: vec3<f32>, least: f32) -> vec3<f32> {
    let across = diagonal - least;
    let a = vec3(across.x, beside.x, beside.y);
    let b = vec3(beside.x, across.y, beside.z);
    let c = vec3(beside.y, beside.z, across.z);
    var longest = cross(a, b);
    let second = cross(b, c);
    if dot(second, second) > dot(longest, longest) { longest = second; }
    let third = cross(c, a);
    if dot(third, third) > dot(longest, longest) { longest = third; }
    let long = length(longest);
    if !(long > 0.0) { return vec3(0.0); }
    return longest / long;
}

// The unit normal of the plane of some points; zero where they do not lie on a plane.
fn plane_normal(near: Neighborhood) -> vec3<f32> {
    if near.count < LEAST_POINTS { return vec3(0.0); }
    let mean = near.sum / near.count;
    let diagonal = near.squares / near.count - mean * mean;
    let beside = near.products / near.count - mean.xxy * mean.yzz;
    let third = (diagonal.x + diagonal.y + diagonal.z) / 3.0;
    let rest = diagonal - third;
    let radius = sqrt((dot(rest, rest) + 2.0 * dot(beside, beside)) / 6.0);
    if !(radius >= NO_SPREAD) { return vec3(0.0); }
    let d = rest / radius;
    let o = beside / radius;
    let half = (d.x * (d.y * d.z - o.z * o.z)
        - o.x * (o.x * d.z - o.z * o.y)
        + o.y * (o.x * o.z - d.y * o.y)) / 2.0;
    let angle = acos(clamp(half, -1.0, 1.0)) / 3.0;
    let most = third + 2.0 * radius * cos(angle);
    let first = third + 2.0 * radius * cos(angle + THIRD_OF_A_TURN);
    // In single precision the least eigenvalue is off where the two least ones are near each other, and
    // arc cosines are not exact on all devices. The Rayleigh quotient of its vector is off by the square.
    let n = eigenvector(diagonal, beside, first);
    if all(n == vec3(0.0)) { return n; }
    let least = dot(n * n, diagonal) + 2.0 * dot(n.xxy * n.yzz, beside);
    let middle = 3.0 * third - most - least;
    if middle - least < FLAT * most { return vec3(0.0); }
    return eigenvector(diagonal, beside, least);
}

@compute @workgroup_size(64)
fn find_normals(@builtin(global_invocation_id) id: vec3<u32>) {
    let view = views[id.y];
    let slot = id.x;
    if slot >= view.free.count + view.taken.count { return; }
    let center = points[view.targets + slot].xyz;
    let radius_m = scene.normal_base_m + scene.normal_slope * length(center.xy);
    let within_m = min(radius_m, scene.match_m);
    var near: Neighborhood;
    add_near(view.free, view.targets, center, within_m, &near);
    add_near(view.taken, view.targets + view.free.count, center, within_m, &near);
    normals[view.normals + slot] = vec4(plane_normal(near), 0.0);
}
