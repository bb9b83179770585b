// The records of the object search. PackedScene of flow/objects has the same; a test compares their
// offsets. Offsets of points are into `points`, those of normals into `normals`; all others are into
// `words`.

// A column index: the hash table of its tiles, its columns and its points in the order of slots.
struct Index {
    // Five words a slot of the table: x and y of the tile, its occupied columns, its first column.
    table: u32,
    // Slots of the table less one.
    mask: u32,
    // Mixed into the keys.
    salt: u32,
    // The first point of each column.
    begins: u32,
    // The first of its points, whose labels are their fourth component.
    points: u32,
    count: u32,
    column_m: f32,
    columns_per_m: f32,
}

// A sweep that clusters are matched to.
struct View {
    free: Index,
    taken: Index,
    // The points of the slots of `free`, then of those of `taken`. Heights are not scaled.
    targets: u32,
    // Their normals, an offset into `normals`.
    normals: u32,
    // Sweep intervals after the source.
    at: i32,
    weight: f32,
}

// The source cloud, the options, and what all clusters share.
struct Scene {
    source: Index,
    // Coordinates of the source points, by row.
    positions: u32,
    // The row of each slot of `source`.
    rows: u32,
    // For each view, one bit a cluster: whether it is clearly static there.
    statics: u32,
    // Words between the bits of two views.
    static_words: u32,
    // The target points that vote.
    voted: Index,
    views: u32,
    // Words of a workgroup's scratch: a sample of the points around by view, and the votes.
    scratch_words: u32,
    // Bins on each side of the zero translation.
    half_bins: i32,
    bin_m: f32,
    vote_within_m: f32,
    cluster_min_points: u32,
    initial_guesses: u32,
    height_weight: f32,
    match_m: f32,
    normal_base_m: f32,
    normal_slope: f32,
    tangential_weight: f32,
    truncation_m: f32,
    close_fit_m: f32,
    displacement_penalty: f32,
    static_fit_m: f32,
    min_motion_m: f32,
    min_gain_m: f32,
    max_cost_ratio: f32,
    min_evidence_m: f32,
    min_evidence_slope: f32,
    max_residual_m: f32,
    min_normal_motion_m: f32,
    neighbor_cost_ratio: f32,
    neighbor_gain_m: f32,
    slow_cost_ratio: f32,
    slow_gain_m: f32,
}

// A cluster to be searched.
struct Cluster {
    label: u32,
    // The rows of its points.
    members: u32,
    count: u32,
    center_x: f32,
    center_y: f32,
}

// A planar motion: a rotation about `center`, then a translation.
struct Motion {
    shift: vec2<f32>,
    center: vec2<f32>,
    turn: f32,
}

// What the search of a cluster found.
struct Found {
    // Costs of standing still: forward and backward.
    still_forward: f32,
    still_backward: f32,
    // Whether there is a hypothesis.
    is_found: u32,
    shift_x: f32,
    shift_y: f32,
    turn: f32,
    forward: f32,
    backward: f32,
    observability: f32,
    normal_motion: f32,
    // Evidence of the neighbor sweeps.
    weight: f32,
    still: f32,
    moved: f32,
    nearest_still: f32,
    nearest_moved: f32,
    forward_still: f32,
    forward_moved: f32,
    agree: u32,
}

@group(0) @binding(0) var<storage, read> words: array<u32>;
@group(0) @binding(1) var<storage, read> scene: Scene;
@group(0) @binding(2) var<storage, read> views: array<View>;
@group(0) @binding(3) var<storage, read> points: array<vec4<f32>>;

// Invocations of a workgroup, which searches one cluster at a time.
const GROUP = 512u;
// Invocations that share the points around one position.
const TEAM = 16u;
// Points of a cluster that costs are computed from, and of the sweep around it.
const JUDGED = 200u;
const MOST_VIEWS = 8u;
const INFINITE = 0x1.fffffep+127f;
