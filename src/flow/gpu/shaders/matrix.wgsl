// Shared by the half-precision kernels: the layout of the points' features in workgroup memory and
// of the middle layers' weights in global memory.
//
// The elements of a cooperative matrix cannot be accessed individually. Products are therefore
// stored to workgroup memory in single precision and rounded there for the next product.

// Points per workgroup: half a tile, so that inputs and products fit into 32 KiB.
const POINTS = 32u;
// Elements from one point's features to the next point's. The padding beyond 128 avoids bank
// conflicts within a column, and keeps rows aligned to 16 bytes.
const INPUT_PITCH = 136u;
const PRODUCT_PITCH = 132u;
// Halves of a layer's weights, stored in blocks of 16 x 16, see halve.wgsl.
const LAYER_HALVES = 16384u;
const BLOCK = 16u;
const BLOCK_HALVES = 256u;
const BLOCKS = 8u;
// The largest finite half.
const LARGEST = 65504.0;

// Index of a tile's first entry among a layer's weights.
fn tile_place(input: u32, output: u32) -> u32 {
    let block = input / BLOCK * BLOCKS + output / BLOCK;
    return block * BLOCK_HALVES + input % BLOCK * BLOCK + output % BLOCK;
}

// Rounds to the nearest half, clamped to the finite range.
fn halved(x: f32) -> f16 {
    return f16(clamp(x, -LARGEST, LARGEST));
}
