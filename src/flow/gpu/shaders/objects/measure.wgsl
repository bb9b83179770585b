// One measurement of a cluster's motion in one view, by all invocations of the workgroup: its cost,
// the normal equations of a step, or how its surfaces determine it. Mirrors ClusterSearch, Sums and
// the matches of Scene.

@group(0) @binding(4) var<storage, read> normals: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> clusters: array<Cluster>;
@group(0) @binding(6) var<storage, read_write> scratch: array<atomic<u32>>;
@group(0) @binding(7) var<storage, read_write> results: array<Found>;

const COST = 0u;
const FIT = 1u;
const SURFACES = 2u;
const VOTES = 3u;
const END = 4u;

// What the first invocation asks the workgroup for.
struct Request {
    kind: u32,
    view: u32,
    // The motion from the source to the view.
    motion: Motion,
    // The motion that the points around are searched at, and whether they are.
    around: Motion,
    is_fresh: u32,
    // Points of the cluster, and most points around it.
    rows: u32,
    most: u32,
    // FIT: the derivative of the repeated motion, its repetitions, and the robust scale.
    swing: vec2<f32>,
    gaps: f32,
    share: f32,
    square_scale: f32,
    // VOTES: bins on each side.
    half_bins: i32,
}

const TERMS = 10u;

var<workgroup> request: Request;
var<workgroup> cluster: Cluster;
// The sum of each term, over the workgroup.
var<workgroup> sums: array<f32, TERMS>;
var<workgroup> partial: array<f32, GROUP>;
var<workgroup> counts: array<u32, GROUP>;
// Number of the points around the cluster, by view.
var<workgroup> around_counts: array<u32, MOST_VIEWS>;

// Most points of a view, one bit each.
const MARK_WORDS = 4096u;

var<workgroup> marks: array<atomic<u32>, MARK_WORDS>;

// The workgroup's words of scratch: points around by view, votes.
var<private> own_scratch: u32;

// The product with the rotation's sine and cosine.
struct Map {
    motion: Motion,
    sine: f32,
    cosine: f32,
}

fn map_of(motion: Motion) -> Map {
    return Map(motion, sin(motion.turn), cos(motion.turn));
}

fn applied(map: Map, point: vec3<f32>) -> vec3<f32> {
    let a = point.xy - map.motion.center;
    let turned = vec2(map.cosine * a.x - map.sine * a.y, map.sine * a.x + map.cosine * a.y);
    return vec3(map.motion.center + map.motion.shift + turned, point.z);
}

fn undone(map: Map, point: vec3<f32>) -> vec3<f32> {
    let a = point.xy - map.motion.center - map.motion.shift;
    let turned = vec2(map.cosine * a.x + map.sine * a.y, map.cosine * a.y - map.sine * a.x);
    return vec3(map.motion.center + turned, point.z);
}

fn lowered(point: vec3<f32>) -> vec3<f32> {
    return vec3(point.xy, point.z * scene.height_weight);
}

fn has_static_matches(view: u32) -> bool {
    let word = words[scene.statics + view * scene.static_words + cluster.label / 32u];
    return (word >> (cluster.label % 32u) & 1u) == 1u;
}

// Point `index` of `count` sampled ones of the cluster.
fn member(index: u32, count: u32) -> vec3<f32> {
    let row = words[cluster.members + index * cluster.count / count];
    return points[scene.positions + row].xyz;
}

// The target point of a view that is nearest to a position, or VACANT.
fn match_of(view: u32, position: vec3<f32>) -> u32 {
    let low = lowered(position);
    var within_m = scene.match_m;
    var own = VACANT;
    if has_static_matches(view) {
        let found = nearest_of(views[view].taken, low, within_m, cluster.label);
        if found.slot != VACANT {
            own = views[view].free.count + found.slot;
            within_m = sqrt(found.square);
        }
    }
    let free = nearest_of(views[view].free, low, within_m, VACANT);
    return select(free.slot, own, free.slot == VACANT);
}

// The distance from a position to a target point, truncated.
fn distance_to(position: vec3<f32>, target_point: vec3<f32>, normal: vec3<f32>) -> f32 {
    let away = target_point - position;
    let low = lowered(away);
    let plain = dot(low, low);
    let along = dot(normal, away);
    let weight = scene.tangential_weight;
    let square = along * along + weight * weight * plain;
    let is_flat = any(normal != vec3(0.0));
    return min(sqrt(select(plain, square, is_flat)), scene.truncation_m);
}

// Marks the points of an index less than `match_m` from a position. Marks begin at bit `first`. The
// invocations of a team share the points.
fn mark(index: Index, center: vec3<f32>, first: u32, label: u32, member: u32) {
    let square = scene.match_m * scene.match_m;
    var walk = begin_walk(index, center.xy, scene.match_m);
    while next_run(index, &walk) {
        for (var slot = walk.begin + member; slot < walk.end; slot += TEAM) {
            let point = points[index.points + slot];
            let away = center - point.xyz;
            let is_wanted = label == VACANT || bitcast<u32>(point.w) == label;
            if dot(away, away) < square && is_wanted {
                let bit = first + slot;
                atomicOr(&marks[bit / 32u], 1u << (bit % 32u));
            }
        }
    }
}

// Searches the target points around the moved cluster and keeps a sample of them.
fn look_around(local: u32, view: u32) {
    let free = views[view].free;
    let slots = free.count + views[view].taken.count;
    let mark_words = (slots + 31u) / 32u;
    for (var word = local; word < mark_words; word += GROUP) {
        atomicStore(&marks[word], 0u);
    }
    workgroupBarrier();
    let map = map_of(request.around);
    for (var i = local / TEAM; i < request.rows; i += GROUP / TEAM) {
        let position = lowered(applied(map, member(i, request.rows)));
        mark(free, position, 0u, VACANT, local % TEAM);
        if has_static_matches(view) {
            mark(views[view].taken, position, free.count, cluster.label, local % TEAM);
        }
    }
    workgroupBarrier();
    // Each invocation counts the marks of its share of the words, in order.
    let share = (mark_words + GROUP - 1u) / GROUP;
    let begin = min(local * share, mark_words);
    let end = min(begin + share, mark_words);
    var count = 0u;
    for (var word = begin; word < end; word++) {
        count += countOneBits(atomicLoad(&marks[word]));
    }
    counts[local] = count;
    for (var stride = 1u; stride < GROUP; stride *= 2u) {
        workgroupBarrier();
        var before = 0u;
        if local >= stride { before = counts[local - stride]; }
        workgroupBarrier();
        counts[local] += before;
    }
    workgroupBarrier();
    let all = counts[GROUP - 1u];
    let kept = min(all, request.most);
    var rank = counts[local] - count;
    let sample = own_scratch + view * JUDGED;
    for (var word = begin; word < end; word++) {
        var bits = atomicLoad(&marks[word]);
        while bits != 0u {
            let bit = countTrailingZeros(bits);
            bits &= bits - 1u;
            // A point is kept if its rank is i * all / kept for some i.
            let i = (rank * kept + all - 1u) / all;
            if i < kept && i * all / kept == rank {
                atomicStore(&scratch[sample + i], 32u * word + bit);
            }
            rank++;
        }
    }
    if local == 0u { around_counts[view] = kept; }
    storageBarrier();
    workgroupBarrier();
}

// Adds the match of a moved point to the terms of a step's normal equations.
fn add_match(
    terms: ptr<function, array<f32, TERMS>>,
    moved: vec3<f32>,
    target_point: vec3<f32>,
    normal: vec3<f32>,
) {
    let distance = distance_to(moved, target_point, normal);
    let robust = request.square_scale / (request.square_scale + distance * distance);
    let weight = robust * robust * request.share;
    let away = target_point - moved;
    let k = request.gaps;
    let pivot = request.motion.center + request.motion.shift;
    let r = k * (moved.xy - pivot);
    let t = vec2(request.swing.x - r.y, request.swing.y + r.x);
    let is_flat = any(normal != vec3(0.0));
    let tangential = select(1.0, scene.tangential_weight, is_flat);
    let along = dot(normal, away);
    let a = k * normal.x;
    let b = k * normal.y;
    let c = dot(normal.xy, t);
    let across = tangential * tangential;
    (*terms)[0] += weight * (a * a + across * k * k);
    (*terms)[1] += weight * (a * b);
    (*terms)[2] += weight * (a * c + across * k * t.x);
    (*terms)[3] += weight * (b * b + across * k * k);
    (*terms)[4] += weight * (b * c + across * k * t.y);
    (*terms)[5] += weight * (c * c + across * dot(t, t));
    (*terms)[6] += weight * (a * along + across * k * away.x);
    (*terms)[7] += weight * (b * along + across * k * away.y);
    (*terms)[8] += weight * (c * along + across * dot(t, away.xy));
    (*terms)[9] += weight;
}

// Measures what `request` asks for, into `sums`.
fn measure(local: u32) {
    let view = request.view;
    if request.is_fresh == 1u { look_around(local, view); }
    let kind = request.kind;
    let map = map_of(request.motion);
    let rows = request.rows;
    let around = select(around_counts[view], 0u, kind == SURFACES);
    let sample = own_scratch + view * JUDGED;
    var terms: array<f32, TERMS>;
    for (var i = local; i < rows + around; i += GROUP) {
        let is_forward = i < rows;
        var start: vec3<f32>;
        var to = VACANT;
        var is_matched = false;
        if is_forward {
            start = member(i, rows);
            to = match_of(view, applied(map, start));
            is_matched = to != VACANT;
        } else {
            to = atomicLoad(&scratch[sample + i - rows]);
            let position = undone(map, points[views[view].targets + to].xyz);
            let origin = nearest_of(scene.source, lowered(position), scene.match_m, cluster.label);
            is_matched = origin.slot != VACANT;
            if is_matched {
                start = points[scene.positions + words[scene.rows + origin.slot]].xyz;
            }
        }
        var distance = scene.truncation_m;
        if is_matched {
            let moved = applied(map, start);
            let target_point = points[views[view].targets + to].xyz;
            let normal = normals[views[view].normals + to].xyz;
            distance = distance_to(moved, target_point, normal);
            if kind == FIT {
                add_match(&terms, moved, target_point, normal);
            } else if kind == SURFACES {
                add_surface(&terms, moved - start, normal);
            }
        }
        if kind == COST {
            terms[select(1u, 0u, is_forward)] += distance;
        }
    }
    let used = select(select(2u, 4u, kind == SURFACES), TERMS, kind == FIT);
    for (var term = 0u; term < used; term++) {
        workgroupBarrier();
        partial[local] = terms[term];
        for (var stride = GROUP / 2u; stride > 0u; stride /= 2u) {
            workgroupBarrier();
            if local < stride { partial[local] += partial[local + stride]; }
        }
        if local == 0u { sums[term] = partial[0]; }
    }
    workgroupBarrier();
}

// Observability of a point without a normal.
const HOLD_OF_A_POINT = 1.0 / 3.0;

// Adds a match to the sums of observability and normal motion.
fn add_surface(terms: ptr<function, array<f32, TERMS>>, way: vec3<f32>, normal: vec3<f32>) {
    (*terms)[0] += 1.0;
    if all(normal == vec3(0.0)) {
        (*terms)[1] += HOLD_OF_A_POINT;
        return;
    }
    let shift = request.motion.shift;
    let direction = shift / max(length(shift), 0x1p-126f);
    let along = dot(normal.xy, direction);
    let passed = dot(normal, way);
    (*terms)[1] += along * along;
    (*terms)[2] += passed * passed;
    (*terms)[3] += 1.0;
}
