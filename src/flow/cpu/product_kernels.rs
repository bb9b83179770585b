//! The matrix products of the linear model: `out = a * b`, in registers.
#![expect(
    unsafe_code,
    reason = "calls into code compiled for instruction sets that were checked"
)]

use super::multiply::{Strided, multiply};
use crate::flow::field::ROW;
use crate::flow::simd::Isa;
use crate::flow::simd::{F32x4, Lanes};
#[cfg(target_arch = "x86_64")]
use crate::flow::simd::{F32x8, F32x16};

/// The two factors of a product, row by row.
#[derive(Clone, Copy)]
pub(super) struct Factors<'a> {
    /// `rows` x `depth`, rows `a_row` floats apart.
    pub(super) a: &'a [f32],
    pub(super) a_row: usize,
    /// `depth` x `columns`, rows `b_row` floats apart.
    pub(super) b: &'a [f32],
    pub(super) b_row: usize,
    pub(super) rows: usize,
    pub(super) depth: usize,
    /// A multiple of [`ROW`].
    pub(super) columns: usize,
}

type Product = unsafe fn(Factors<'_>, &mut [f32], usize);

/// The product of one instruction set.
#[derive(Clone, Copy)]
pub(super) struct ProductKernel(Product);

impl ProductKernel {
    /// The kernel of `isa`.
    ///
    /// # Panics
    /// If the machine lacks the instruction set.
    pub(super) fn new(isa: Isa) -> Self {
        assert!(Isa::available().contains(&isa), "{isa:?} is not available");
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => Self(product_avx512),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => Self(product_avx2),
            _ => Self(product_portable),
        }
    }

    /// Writes the product to `out`, whose rows are `out_row` floats apart.
    ///
    /// # Panics
    /// If a slice is too short for its rows, or the columns are no multiple of [`ROW`].
    pub(super) fn multiply(&self, factors: Factors<'_>, out: &mut [f32], out_row: usize) {
        let Factors {
            a,
            a_row,
            b,
            b_row,
            rows,
            depth,
            columns,
        } = factors;
        let holds = |floats: usize, rows: usize, row: usize, columns: usize| {
            rows == 0 || (rows - 1) * row + columns <= floats
        };
        assert!(columns.is_multiple_of(ROW), "whole registers");
        assert!(holds(a.len(), rows, a_row, depth), "the first factor");
        assert!(holds(b.len(), depth, b_row, columns), "the second factor");
        assert!(holds(out.len(), rows, out_row, columns), "the product");
        // SAFETY: `new` checked the instruction set, and the slices hold their rows.
        unsafe { (self.0)(factors, out, out_row) }
    }
}

/// The product, in tiles of `ROWS` rows by two registers. What is left takes smaller tiles.
///
/// # Safety
/// The caller has the instruction set of `L`. The slices hold the rows of the factors and of the
/// product, and the columns are a multiple of [`ROW`].
#[inline(always)]
unsafe fn product<L: Lanes, const ROWS: usize>(factors: Factors<'_>, out: &mut [f32], row: usize) {
    let mut first = 0;
    // SAFETY: as for this function; each tile lies within the product.
    unsafe {
        while first + ROWS <= factors.rows {
            tiles::<L, ROWS>(factors, first, out, row);
            first += ROWS;
        }
        while first < factors.rows {
            tiles::<L, 1>(factors, first, out, row);
            first += 1;
        }
    }
}

/// The tiles of `ROWS` rows of the product from `first` on.
///
/// # Safety
/// As for [`product`], and these rows lie within the product.
#[inline(always)]
unsafe fn tiles<L: Lanes, const ROWS: usize>(
    factors: Factors<'_>,
    first: usize,
    out: &mut [f32],
    row: usize,
) {
    // SAFETY: as for this function.
    unsafe {
        let a = Strided {
            at: factors.a.as_ptr().add(first * factors.a_row),
            row: factors.a_row,
            step: 1,
        };
        let out = out.as_mut_ptr().add(first * row);
        let mut column = 0;
        while column + 2 * L::COUNT <= factors.columns {
            tile::<L, ROWS, 2>(factors, a, column, out, row);
            column += 2 * L::COUNT;
        }
        while column < factors.columns {
            tile::<L, ROWS, 1>(factors, a, column, out, row);
            column += L::COUNT;
        }
    }
}

/// One tile of the product.
///
/// # Safety
/// As for [`tiles`], and these columns lie within the product.
#[inline(always)]
unsafe fn tile<L: Lanes, const ROWS: usize, const VECTORS: usize>(
    factors: Factors<'_>,
    a: Strided,
    column: usize,
    out: *mut f32,
    row: usize,
) {
    // SAFETY: as for this function.
    unsafe {
        let mut sums = [[L::splat(0.0); VECTORS]; ROWS];
        let b = factors.b.as_ptr().add(column);
        multiply(&mut sums, factors.depth, a, b, factors.b_row);
        for (number, sums) in sums.into_iter().enumerate() {
            for (vector, sum) in sums.into_iter().enumerate() {
                sum.store(out.add(number * row + column + vector * L::COUNT));
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn product_avx512(factors: Factors<'_>, out: &mut [f32], row: usize) {
    // SAFETY: avx512f is enabled.
    unsafe { product::<F32x16, 12>(factors, out, row) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn product_avx2(factors: Factors<'_>, out: &mut [f32], row: usize) {
    // SAFETY: avx2 and fma are enabled.
    unsafe { product::<F32x8, 6>(factors, out, row) }
}
unsafe fn product_portable(factors: Factors<'_>, out: &mut [f32], row: usize) {
    // SAFETY: plain Rust needs no CPU feature.
    unsafe { product::<F32x4, 6>(factors, out, row) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;

    #[test]
    fn every_instruction_set_multiplies_at_awkward_sizes() {
        // Rounding of single-precision sums of up to 130 products of numbers below 1.
        const TOLERANCE: f64 = 1e-5;
        let mut random = Random::new(3);
        let mut floats = |count: usize| -> Vec<f32> {
            (0..count)
                .map(|_| random.uniform(-1.0, 1.0) as f32)
                .collect()
        };
        for (rows, depth, columns) in [(1, 1, 16), (5, 7, 16), (12, 16, 48), (13, 130, 112)] {
            let (a_row, b_row, out_row) = (depth + 3, columns + 16, columns + 5);
            let (a, b) = (floats(rows * a_row), floats(depth * b_row));
            for isa in Isa::available() {
                let mut out = vec![f32::NAN; rows * out_row];
                let factors = Factors {
                    a: &a,
                    a_row,
                    b: &b,
                    b_row,
                    rows,
                    depth,
                    columns,
                };
                ProductKernel::new(isa).multiply(factors, &mut out, out_row);
                for row in 0..rows {
                    for column in 0..columns {
                        let expected: f64 = (0..depth)
                            .map(|k| {
                                f64::from(a[row * a_row + k]) * f64::from(b[k * b_row + column])
                            })
                            .sum();
                        let error = (f64::from(out[row * out_row + column]) - expected).abs();
                        assert!(error < TOLERANCE, "{isa:?} {row} {column}: {error}");
                    }
                }
            }
        }
    }
}
