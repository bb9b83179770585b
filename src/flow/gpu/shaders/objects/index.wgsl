// Queries on a column index: mirrors ColumnIndex and Tiles.

const SIDE_BITS = 3u;
const VACANT = 0xffffffffu;
const REACH = 1073741824.0;

// The columns that a square touches, and the run of points that was found last.
struct Walk {
    low: vec2<i32>,
    high: vec2<i32>,
    tile: vec2<i32>,
    // The next column along x.
    x: i32,
    // The occupied columns of the tile, and its first one.
    occupied: vec2<u32>,
    first: u32,
    begin: u32,
    end: u32,
}

fn columns_of(index: Index, position: vec2<f32>) -> vec2<i32> {
    var columns = position * index.columns_per_m;
    // What is no number lies beyond the reach.
    columns = select(vec2(REACH), columns, columns < vec2(REACH));
    columns = select(vec2(-REACH), columns, columns > vec2(-REACH));
    return vec2<i32>(floor(columns));
}

// A walk over the columns that touch the square of half side `half_m` around a position.
fn begin_walk(index: Index, position: vec2<f32>, half_m: f32) -> Walk {
    var walk: Walk;
    walk.low = columns_of(index, position - half_m);
    walk.high = columns_of(index, position + half_m);
    walk.tile = walk.low >> vec2(SIDE_BITS);
    walk.x = walk.low.x;
    enter(index, &walk);
    return walk;
}

// Looks up the walk's tile.
fn enter(index: Index, walk: ptr<function, Walk>) {
    let tile = bitcast<vec2<u32>>((*walk).tile);
    var hash = (tile.x ^ (index.salt * 0x9e3779b9u)) * 0x9e3779b1u + tile.y * 0x85ebca77u;
    hash = (hash ^ (hash >> 15u)) * 0xc2b2ae35u;
    var slot = (hash ^ (hash >> 13u)) & index.mask;
    (*walk).occupied = vec2(0u);
    // The table is half full at most.
    loop {
        let at = index.table + 5u * slot;
        let first = words[at + 4u];
        if first == VACANT { break; }
        if words[at] == tile.x && words[at + 1u] == tile.y {
            (*walk).occupied = vec2(words[at + 2u], words[at + 3u]);
            (*walk).first = first;
            break;
        }
        slot = (slot + 1u) & index.mask;
    }
}

// Whether there is another run of points, and finds it. Runs ascend.
fn next_run(index: Index, walk: ptr<function, Walk>) -> bool {
    loop {
        let origin = (*walk).tile << vec2(SIDE_BITS);
        let last_x = min((*walk).high.x, origin.x + 7);
        while (*walk).x <= last_x {
            let x = u32((*walk).x - origin.x);
            (*walk).x++;
            let y_low = u32(max((*walk).low.y, origin.y) - origin.y);
            let y_high = u32(min((*walk).high.y, origin.y + 7) - origin.y);
            let row = ((2u << (y_high - y_low)) - 1u) << y_low;
            // The columns of four values of x are in the low word, those of the others in the high one.
            let half = select((*walk).occupied.x, (*walk).occupied.y, x >= 4u);
            let place = (x & 3u) << SIDE_BITS;
            let wanted = countOneBits(half & (row << place));
            if wanted > 0u {
                let before = countOneBits(half & ((1u << (place + y_low)) - 1u))
                    + select(0u, countOneBits((*walk).occupied.x), x >= 4u);
                let first = index.begins + (*walk).first + before;
                (*walk).begin = words[first];
                (*walk).end = words[first + wanted];
                return true;
            }
        }
        (*walk).tile.y++;
        if (*walk).tile.y > (*walk).high.y >> SIDE_BITS {
            (*walk).tile = vec2((*walk).tile.x + 1, (*walk).low.y >> SIDE_BITS);
        }
        if (*walk).tile.x > (*walk).high.x >> SIDE_BITS { break; }
        (*walk).x = max((*walk).low.x, (*walk).tile.x << SIDE_BITS);
        enter(index, walk);
    }
    return false;
}

// A point that a search found; the slot is VACANT if there is none.
struct Nearest {
    slot: u32,
    square: f32,
}

// The nearest point whose squared distance is below `square`, in the columns that touch a square.
// Of equally near points it is the one of the lowest slot.
fn nearest_in(index: Index, center: vec3<f32>, square: f32, half_m: f32, label: u32) -> Nearest {
    var found = Nearest(VACANT, square);
    var walk = begin_walk(index, center.xy, half_m);
    while next_run(index, &walk) {
        for (var slot = walk.begin; slot < walk.end; slot++) {
            let point = points[index.points + slot];
            let away = center - point.xyz;
            let here = dot(away, away);
            let is_wanted = label == VACANT || bitcast<u32>(point.w) == label;
            if here < found.square && is_wanted {
                found = Nearest(slot, here);
            }
        }
    }
    return found;
}

// The nearest point less than `within_m` metres from `center`. With a label other than VACANT, of
// those with this label.
fn nearest_of(index: Index, center: vec3<f32>, within_m: f32, label: u32) -> Nearest {
    // The columns within half a side are at most four, and hold the nearest point of most queries.
    let half_m = 0.5 * index.column_m;
    var reach_m = within_m;
    if half_m < within_m {
        let found = nearest_in(index, center, within_m * within_m, half_m, label);
        if found.slot != VACANT {
            if found.square < half_m * half_m { return found; }
            reach_m = min(sqrt(found.square) * 1.000001, within_m);
        }
    }
    return nearest_in(index, center, within_m * within_m, reach_m, label);
}
