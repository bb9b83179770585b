// A middle layer's matrix product on the matrix units, for the forward and the backward pass: all
// points' features in `inputs` times a layer's weights in `halves`, into `products`. This file is
// placed before a kernel that defines `right`, which loads a tile of the weights, transposed or
// not.
//
// A matrix operation is executed by a whole subgroup of any size. Subgroups take squares of two by
// two tiles in turn.

// Number of squares across the features, and in total.
const SQUARES_ACROSS = WIDTH / (2u * SIDE);
const SQUARE_COUNT = POINTS / (2u * SIDE) * SQUARES_ACROSS;

var<workgroup> inputs: array<f16, 4352>;
var<workgroup> products: array<f32, 4224>;

fn multiply(weights: u32, subgroup: u32, subgroups: u32) {
    for (var square = subgroup; square < SQUARE_COUNT; square += subgroups) {
        let top = square / SQUARES_ACROSS * 2u * SIDE;
        let left = square % SQUARES_ACROSS * 2u * SIDE;
        var upper_left = Sums();
        var upper_right = Sums();
        var lower_left = Sums();
        var lower_right = Sums();
        for (var k = 0u; k < WIDTH; k += SIDE) {
            let upper = coopLoadT<Left>(&inputs[top * INPUT_PITCH + k], INPUT_PITCH);
            let lower = coopLoadT<Left>(&inputs[(top + SIDE) * INPUT_PITCH + k], INPUT_PITCH);
            let first = right(weights, k, left);
            let second = right(weights, k, left + SIDE);
            upper_left = coopMultiplyAdd(upper, first, upper_left);
            upper_right = coopMultiplyAdd(upper, second, upper_right);
            lower_left = coopMultiplyAdd(lower, first, lower_left);
            lower_right = coopMultiplyAdd(lower, second, lower_right);
        }
        let at = top * PRODUCT_PITCH + left;
        let below = at + SIDE * PRODUCT_PITCH;
        coopStoreT(upper_left, &products[at], PRODUCT_PITCH);
        coopStoreT(upper_right, &products[at + SIDE], PRODUCT_PITCH);
        coopStoreT(lower_left, &products[below], PRODUCT_PITCH);
        coopStoreT(lower_right, &products[below + SIDE], PRODUCT_PITCH);
    }
}
