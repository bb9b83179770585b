//! Forward and backward passes of the network over one tile, generic over [`Lanes`].
//!
//! The inner loops compute register tiles of `ROWS` points by `VECTORS` registers. Every operand is
//! read in its memory order. Every sum is taken in the same order as in the shaders of `flow/gpu`.
#![expect(
    unsafe_code,
    reason = "register-tiled loops over raw rows, compiled per instruction set"
)]
#![expect(
    clippy::needless_range_loop,
    reason = "registers are named by row and vector, as in the formulas"
)]

use super::multiply::{Strided, multiply};
use super::tile::{ROW_STEP, SIDE_BY_SIDE, STRIDE, TILE, Tile};
use crate::flow::field::{
    MIDDLE_LAYERS, PANEL, WIDTH, first_layer, last_layer, middle_layer, tree_sum,
};
use crate::flow::simd::Lanes;

/// Calls `body` with the first column of each register group of a 128-feature row, and the offset
/// of that column's panel.
#[inline(always)]
fn for_columns<L: Lanes, const VECTORS: usize>(mut body: impl FnMut(usize, usize)) {
    let group = VECTORS * L::COUNT;
    let mut column = 0;
    while column < WIDTH {
        body(column, column / PANEL * WIDTH * PANEL + column % PANEL);
        column += group;
    }
}

/// `outputs = g(inputs)`, layer by layer.
///
/// # Safety
/// The caller has enabled the instruction set of `L`, and every array of parameters has
/// [`crate::flow::field::LAID_OUT`] floats.
#[inline(always)]
pub(super) unsafe fn forward<L: Lanes, const ROWS: usize, const VECTORS: usize>(
    parameters: &[f32],
    tile: &mut Tile,
) {
    const {
        assert!(ROW_STEP.is_multiple_of(ROWS) && PANEL.is_multiple_of(VECTORS * L::COUNT));
        assert!(SIDE_BY_SIDE.is_multiple_of(L::COUNT));
    }
    let rows = tile.padded_rows();
    let weights = parameters.as_ptr();
    let activations = tile.activations.as_mut_slice().as_mut_ptr();
    // SAFETY: every offset stays within the layouts of a network and of `Tile`.
    unsafe {
        let at = first_layer();
        for column in (0..WIDTH).step_by(L::COUNT) {
            let w: [L; 3] =
                core::array::from_fn(|i| L::load(weights.add(at.weights + i * WIDTH + column)));
            let bias = L::load(weights.add(at.bias + column));
            for row in 0..rows {
                let x = tile.inputs[row];
                let sum = L::splat(x[0]).mul_add(w[0], bias);
                let sum = L::splat(x[1]).mul_add(w[1], sum);
                let sum = L::splat(x[2]).mul_add(w[2], sum);
                sum.relu().store(activations.add(row * STRIDE + column));
            }
        }
        for layer in 0..MIDDLE_LAYERS {
            let at = middle_layer(layer);
            let from = activations.add(layer * TILE * STRIDE);
            let to = activations.add((layer + 1) * TILE * STRIDE);
            for_columns::<L, VECTORS>(|column, panel| {
                for row in (0..rows).step_by(ROWS) {
                    let bias: [L; VECTORS] = core::array::from_fn(|v| {
                        L::load(weights.add(at.bias + column + v * L::COUNT))
                    });
                    let mut acc = [bias; ROWS];
                    let a = Strided {
                        at: from.add(row * STRIDE),
                        row: STRIDE,
                        step: 1,
                    };
                    multiply(&mut acc, WIDTH, a, weights.add(at.weights + panel), PANEL);
                    for r in 0..ROWS {
                        for v in 0..VECTORS {
                            let out = to.add((row + r) * STRIDE + column + v * L::COUNT);
                            acc[r][v].relu().store(out);
                        }
                    }
                }
            });
        }
        let at = last_layer();
        let from = activations.add(MIDDLE_LAYERS * TILE * STRIDE);
        for row in 0..tile.rows {
            let mut sums = [[0.0; SIDE_BY_SIDE]; 3];
            for first in (0..SIDE_BY_SIDE).step_by(L::COUNT) {
                let mut acc = [L::splat(0.0); 3];
                for column in (first..WIDTH).step_by(SIDE_BY_SIDE) {
                    let h = L::load(from.add(row * STRIDE + column));
                    for output in 0..3 {
                        let w = L::load(weights.add(at.weights + output * WIDTH + column));
                        acc[output] = h.mul_add(w, acc[output]);
                    }
                }
                for output in 0..3 {
                    acc[output].store(sums[output].as_mut_ptr().add(first));
                }
            }
            for output in 0..3 {
                tile.outputs[row][output] = tree_sum(sums[output]) + *weights.add(at.bias + output);
            }
        }
    }
}

/// Adds the derivatives of `output_gradients . g(inputs)` with respect to every parameter to
/// `gradients`. `TAIL` is the group size for the `128 mod ROWS` remaining inputs, and divides their
/// number.
///
/// # Safety
/// The caller has enabled the instruction set of `L`, and every array of parameters has
/// [`crate::flow::field::LAID_OUT`] floats.
#[inline(always)]
pub(super) unsafe fn backward<
    L: Lanes,
    const ROWS: usize,
    const TAIL: usize,
    const VECTORS: usize,
>(
    parameters: &[f32],
    transposed: &[f32],
    tile: &mut Tile,
    gradients: &mut [f32],
) {
    const {
        assert!(ROW_STEP.is_multiple_of(ROWS) && PANEL.is_multiple_of(VECTORS * L::COUNT));
        assert!((WIDTH % ROWS).is_multiple_of(TAIL));
    }
    let rows = tile.padded_rows();
    let weights = parameters.as_ptr();
    let transposes = transposed.as_ptr();
    let grads = gradients.as_mut_ptr();
    let activations = tile.activations.as_slice().as_ptr();
    let [first, second] = &mut tile.deltas;
    let mut delta = first.as_mut_slice().as_mut_ptr();
    let mut next_delta = second.as_mut_slice().as_mut_ptr();
    // SAFETY: every offset stays within the layouts of a network and of `Tile`.
    unsafe {
        let at = last_layer();
        let h = activations.add(MIDDLE_LAYERS * TILE * STRIDE);
        for column in (0..WIDTH).step_by(L::COUNT) {
            let w: [L; 3] =
                core::array::from_fn(|o| L::load(weights.add(at.weights + o * WIDTH + column)));
            let mut dw: [L; 3] =
                core::array::from_fn(|o| L::load(grads.add(at.weights + o * WIDTH + column)));
            for row in 0..rows {
                let g = tile.output_gradients[row].map(|g| L::splat(g));
                let h = L::load(h.add(row * STRIDE + column));
                for o in 0..3 {
                    dw[o] = g[o].mul_add(h, dw[o]);
                }
                let d = g[0].mul_add(w[0], g[1].mul_add(w[1], g[2].mul_add(w[2], L::splat(0.0))));
                d.where_positive(h).store(delta.add(row * STRIDE + column));
            }
            for o in 0..3 {
                dw[o].store(grads.add(at.weights + o * WIDTH + column));
            }
        }
        for gradient in &tile.output_gradients[..tile.rows] {
            for o in 0..3 {
                *grads.add(at.bias + o) += gradient[o];
            }
        }

        for layer in (0..MIDDLE_LAYERS).rev() {
            let at = middle_layer(layer);
            let h = activations.add(layer * TILE * STRIDE);
            add_column_sums::<L>(delta, rows, grads.add(at.bias));
            for_columns::<L, VECTORS>(|column, panel| {
                let b = delta.cast_const().add(column);
                let to = grads.add(at.weights + panel);
                let mut k = 0;
                while k + ROWS <= WIDTH {
                    weight_gradient::<L, ROWS, VECTORS>(h.add(k), rows, b, to.add(k * PANEL));
                    k += ROWS;
                }
                while k < WIDTH {
                    weight_gradient::<L, TAIL, VECTORS>(h.add(k), rows, b, to.add(k * PANEL));
                    k += TAIL;
                }
            });
            for_columns::<L, VECTORS>(|column, panel| {
                for row in (0..rows).step_by(ROWS) {
                    let mut acc = [[L::splat(0.0); VECTORS]; ROWS];
                    let a = Strided {
                        at: delta.add(row * STRIDE),
                        row: STRIDE,
                        step: 1,
                    };
                    multiply(
                        &mut acc,
                        WIDTH,
                        a,
                        transposes.add(at.weights + panel),
                        PANEL,
                    );
                    for r in 0..ROWS {
                        for v in 0..VECTORS {
                            let index = (row + r) * STRIDE + column + v * L::COUNT;
                            let gate = L::load(h.add(index));
                            acc[r][v].where_positive(gate).store(next_delta.add(index));
                        }
                    }
                }
            });
            core::mem::swap(&mut delta, &mut next_delta);
        }

        let at = first_layer();
        add_column_sums::<L>(delta, rows, grads.add(at.bias));
        for column in (0..WIDTH).step_by(L::COUNT) {
            let mut dw: [L; 3] =
                core::array::from_fn(|i| L::load(grads.add(at.weights + i * WIDTH + column)));
            for row in 0..rows {
                let d = L::load(delta.add(row * STRIDE + column));
                for i in 0..3 {
                    dw[i] = L::splat(tile.inputs[row][i]).mul_add(d, dw[i]);
                }
            }
            for i in 0..3 {
                dw[i].store(grads.add(at.weights + i * WIDTH + column));
            }
        }
    }
}

/// `to[0..128] +=` the sum of the rows.
#[inline(always)]
unsafe fn add_column_sums<L: Lanes>(from: *const f32, rows: usize, to: *mut f32) {
    for column in (0..WIDTH).step_by(L::COUNT) {
        // SAFETY: `from` holds `rows` rows and `to` holds 128 floats.
        unsafe {
            let mut sum = L::load(to.add(column));
            for row in 0..rows {
                sum = sum.add(L::load(from.add(row * STRIDE + column)));
            }
            sum.store(to.add(column));
        }
    }
}

/// Adds `sum_p h[p][k] * d[p][n]` to `ROWS` inputs k by one register group of outputs n.
#[inline(always)]
unsafe fn weight_gradient<L: Lanes, const ROWS: usize, const VECTORS: usize>(
    h: *const f32,
    points: usize,
    d: *const f32,
    to: *mut f32,
) {
    // SAFETY: `h` and `d` hold `points` rows, `to` holds `ROWS` rows of a panel.
    unsafe {
        let mut acc = [[L::splat(0.0); VECTORS]; ROWS];
        for r in 0..ROWS {
            for v in 0..VECTORS {
                acc[r][v] = L::load(to.add(r * PANEL + v * L::COUNT));
            }
        }
        multiply(
            &mut acc,
            points,
            Strided {
                at: h,
                row: 1,
                step: STRIDE,
            },
            d,
            STRIDE,
        );
        for r in 0..ROWS {
            for v in 0..VECTORS {
                acc[r][v].store(to.add(r * PANEL + v * L::COUNT));
            }
        }
    }
}
