//! Sums over the points around a center, for their mean and covariance.
//!
//! The kernel is written once for all instruction sets. Products are exact in double precision. Each
//! sum is taken in four parts, whatever the register, so that all sets give the same bits.
#![expect(
    unsafe_code,
    reason = "vector kernels, compiled for instruction sets that were checked"
)]

use super::column_kernels::{away_at, splat, square_around, squares_of};
use super::slots::{MOST_LANES, Slots};
use crate::flow::data::Point;
use crate::flow::simd::{F32x4, Isa, Lanes};
#[cfg(target_arch = "x86_64")]
use crate::flow::simd::{F32x8, F32x16};

/// The numbers of the floats of a register.
const NUMBERS: [f32; MOST_LANES] = [
    0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0,
];

/// Sums over the points within a radius of a center.
pub(super) struct Neighborhood {
    pub(super) count: f64,
    /// Sums of x, y and z: the offsets of the center from the points, metres.
    pub(super) sum: [f64; 3],
    /// Sums of x x, x y, x z, y y, y z and z z, square metres.
    pub(super) products: [f64; 6],
}

impl Neighborhood {
    /// Sums over the points less than `within_m` metres from `center`.
    #[inline]
    pub(super) fn of(isa: Isa, slots: &Slots, center: Point, within_m: f32) -> Self {
        // SAFETY: an index takes an instruction set of the machine only. The slots are padded.
        unsafe {
            match isa {
                #[cfg(target_arch = "x86_64")]
                Isa::Avx512 => of_avx512(slots, center, within_m),
                #[cfg(target_arch = "x86_64")]
                Isa::Avx2 => of_avx2(slots, center, within_m),
                _ => of_in::<F32x4>(slots, center, within_m),
            }
        }
    }
}

/// # Safety
/// The caller has the instruction set of `L`.
#[inline(always)]
unsafe fn of_in<L: Lanes>(slots: &Slots, center: Point, within_m: f32) -> Neighborhood {
    let mut count = 0;
    let mut sums = [[0.0_f64; 4]; 9];
    let corners = square_around(center, within_m);
    // SAFETY: the caller has the instruction set. Loads begin at slots that exist and end before
    // the padding does. The numbers fill a register.
    unsafe {
        let center = splat::<L>(center);
        let limit = L::splat(within_m * within_m);
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        let far = L::splat(f32::INFINITY);
        let numbers = L::load(NUMBERS.as_ptr());
        slots.tiles.each_run(corners, |run| {
            let mut first = run.start;
            while first < run.end {
                let away = away_at::<L>(slots, center, first);
                // What follows the run are points of other columns.
                let left = L::splat((run.end - first) as f32);
                let squares = squares_of(away).where_less(numbers, left, far);
                let near = squares.less(limit).count_ones();
                if near > 0 {
                    count += near;
                    let [x, y, z] = away;
                    let x = x.where_less(squares, limit, zero);
                    let y = y.where_less(squares, limit, zero);
                    let z = z.where_less(squares, limit, zero);
                    let from = [x, y, z, x, x, x, y, y, z];
                    let with = [one, one, one, x, y, z, y, z, z];
                    for ((sum, a), b) in sums.iter_mut().zip(from).zip(with) {
                        *sum = a.add_products(b, *sum);
                    }
                }
                first += L::COUNT;
            }
        });
    }
    let [x, y, z, xx, xy, xz, yy, yz, zz] = sums.map(|[a, b, c, d]| (a + b) + (c + d));
    Neighborhood {
        count: f64::from(count),
        sum: [x, y, z],
        products: [xx, xy, xz, yy, yz, zz],
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,popcnt")]
unsafe fn of_avx512(slots: &Slots, center: Point, within_m: f32) -> Neighborhood {
    // SAFETY: the features are enabled.
    unsafe { of_in::<F32x16>(slots, center, within_m) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,popcnt")]
unsafe fn of_avx2(slots: &Slots, center: Point, within_m: f32) -> Neighborhood {
    // SAFETY: the features are enabled.
    unsafe { of_in::<F32x8>(slots, center, within_m) }
}
