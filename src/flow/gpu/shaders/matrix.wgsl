// What the kernels of half precision share: how points' features lie in workgroup memory, and how
// the middle layers' weights lie in theirs.
//
// No element of a matrix can be seen where the units hold it, so products go to workgroup memory as
// singles, and from there as halves into the next one.

// Points that one workgroup looks at: half of a tile of the plan, so that inputs and products fit
// into 32 KiB.
const POINTS = 32u;
// Floats from one point's features to the next's: a few more than they are, so that a column's
// entries lie in different banks, and tiles still begin at multiples of 16 bytes.
const INPUT_PITCH = 136u;
const PRODUCT_PITCH = 132u;
// Halves of a layer's weights, which lie in blocks of 16 x 16, see halve.wgsl.
const LAYER_HALVES = 16384u;
const BLOCK = 16u;
const BLOCK_HALVES = 256u;
const BLOCKS = 8u;
// The largest half: larger ones would be infinite.
const LARGEST = 65504.0;

// The place of a tile's first entry among a layer's weights.
fn tile_place(input: u32, output: u32) -> u32 {
    let block = input / BLOCK * BLOCKS + output / BLOCK;
    return block * BLOCK_HALVES + input % BLOCK * BLOCK + output % BLOCK;
}

// The nearest half.
fn halved(x: f32) -> f16 {
    return f16(clamp(x, -LARGEST, LARGEST));
}
