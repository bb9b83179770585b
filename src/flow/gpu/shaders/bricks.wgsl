// Exact distances at the vertices of the active bricks, one brick per workgroup.
//
// In: the occupied columns, each with its squared distances along z, and the positions of the
// bricks. Out: 512 16-bit codes per brick, in the store: distance in units of code_scale, or
// BEYOND. Mirrors CellGather bit by bit: squared distances are integers.
//
// An invocation computes 8 vertices along x for one y and two z. It iterates over the rows of
// columns in x. The minimum of each row over y and z is shared by all eight vertices.

struct Plan {
    band: i32,
    // Number of rows of columns along x.
    rows: u32,
    // Number of bricks, and the offset of their codes in the store, words.
    bricks: u32,
    codes: u32,
}

@group(0) @binding(0) var<storage, read> plan: array<Plan>;
// Position of each brick, in bricks from the origin.
@group(0) @binding(1) var<storage, read> places: array<u32>;
// Index of the first column of each row, followed by the end of the last row.
@group(0) @binding(2) var<storage, read> starts: array<u32>;
// Per column: its y, the brick layer at which its squares begin, and their offset. One more entry
// at the end.
@group(0) @binding(3) var<storage, read> columns: array<Column>;
// Eight 16-bit squared distances per layer.
@group(0) @binding(4) var<storage, read> squares: array<u32>;
// The code of each squared distance up to the band's, then BEYOND.
@group(0) @binding(5) var<storage, read> code_of: array<u32>;
@group(0) @binding(6) var<storage, read_write> store: array<u32>;

struct Column {
    y: i32,
    layer: u32,
    squares: u32,
}

// Larger than any squared distance within the band.
const FAR = 0x3fff;

@compute @workgroup_size(32)
fn bricks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let brick = group.y * groups.x + group.x;
    if brick >= plan[0].bricks { return; }
    let band = plan[0].band;
    let layer = places[brick * 3u + 2u];
    let x = i32(places[brick * 3u] * 8u);
    let top = i32(places[brick * 3u + 1u] * 8u);
    let y = top + i32(local / 4u);
    let pair = local % 4u;

    var least: array<vec2<i32>, 8>;
    for (var i = 0u; i < 8u; i++) {
        least[i] = vec2(FAR);
    }
    let last_row = min(x + 8 + band, i32(plan[0].rows));
    for (var row = max(x - band, 0); row < last_row; row++) {
        let end = starts[row + 1];
        var along = vec2(FAR);
        for (var column = first_from(starts[row], end, top - band); column < end; column++) {
            let at = columns[column];
            if at.y >= top + 8 + band { break; }
            let slot = at.squares + layer - at.layer;
            if layer < at.layer || slot >= columns[column + 1u].squares { continue; }
            let word = squares[slot * 4u + pair];
            let gap = y - at.y;
            along = min(along, vec2(i32(word & 0xffffu), i32(word >> 16u)) + gap * gap);
        }
        for (var i = 0; i < 8; i++) {
            let gap = x + i - row;
            least[i] = min(least[i], along + gap * gap);
        }
    }
    let beyond = band * band + 1;
    for (var i = 0u; i < 8u; i++) {
        let square = min(least[i], vec2(beyond));
        let word = code_of[square.x] | (code_of[square.y] << 16u);
        store[plan[0].codes + brick * 256u + i * 32u + local] = word;
    }
}

// The first column of a row with this or a larger `y`.
fn first_from(start: u32, end: u32, y: i32) -> u32 {
    var low = start;
    var high = end;
    while low < high {
        let middle = (low + high) / 2u;
        if columns[middle].y < y {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}
