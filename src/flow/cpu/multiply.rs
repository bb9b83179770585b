//! The innermost loop of all matrix products: a register tile of rows by vectors.
#![expect(
    unsafe_code,
    reason = "register-tiled loops over raw rows, compiled per instruction set"
)]
#![expect(
    clippy::needless_range_loop,
    reason = "registers are named by row and vector, as in the formulas"
)]

use crate::flow::simd::Lanes;

/// A strided matrix: its first element, the floats from one row to the next, and the floats from
/// one step of the summed index to the next.
#[derive(Clone, Copy)]
pub(super) struct Strided {
    pub(super) at: *const f32,
    pub(super) row: usize,
    pub(super) step: usize,
}

/// `acc[r][..] += sum_k a[r][k] * b[k][..]`: `ROWS` x `VECTORS` registers.
///
/// # Safety
/// `a` has `ROWS` rows and `depth` steps. `b` has `depth` rows of `VECTORS` registers, `b_step`
/// floats apart.
#[inline(always)]
pub(super) unsafe fn multiply<L: Lanes, const ROWS: usize, const VECTORS: usize>(
    acc: &mut [[L; VECTORS]; ROWS],
    depth: usize,
    a: Strided,
    b: *const f32,
    b_step: usize,
) {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let mut a_at = a.at;
        let mut b_at = b;
        for _ in 0..depth {
            let mut row = [L::splat(0.0); VECTORS];
            for v in 0..VECTORS {
                row[v] = L::load(b_at.add(v * L::COUNT));
            }
            for r in 0..ROWS {
                let scale = L::splat(*a_at.add(r * a.row));
                for v in 0..VECTORS {
                    acc[r][v] = scale.mul_add(row[v], acc[r][v]);
                }
            }
            a_at = a_at.add(a.step);
            b_at = b_at.add(b_step);
        }
    }
}
