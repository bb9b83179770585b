//! The kernels of the column index: squared distances from one position to runs of points, a
//! register of points at a time.
//!
//! Each is written once for all instruction sets. Products and sums are rounded separately and
//! each lane holds the distance of one point, so that results have the same bits on all of them.
#![expect(
    unsafe_code,
    reason = "vector kernels, compiled for instruction sets that were checked"
)]

use super::slots::{MOST_LANES, Slots};
use crate::flow::data::Point;
use crate::flow::simd::{F32x4, Isa, Lanes};
#[cfg(target_arch = "x86_64")]
use crate::flow::simd::{F32x8, F32x16};

/// The points that a search may find.
#[derive(Clone, Copy)]
pub(super) struct Wanted<'a> {
    pub(super) center: Point,
    /// Squared distance that a point must be below, square metres.
    pub(super) square: f32,
    /// A label for each slot, and the label that a point must have.
    pub(super) label: Option<(&'a [f32], f32)>,
}

/// A search in the columns that touch the square of half side `half_m` around the center.
///
/// Returns the squared distance and the slot of the nearest point. Of equally near points it is the
/// one of the lowest slot.
pub(super) fn nearest(
    isa: Isa,
    slots: &Slots,
    wanted: Wanted<'_>,
    half_m: f32,
) -> Option<(f32, usize)> {
    if let Some((labels, _)) = wanted.label {
        assert_eq!(labels.len(), slots.padded());
    }
    // SAFETY: an index takes an instruction set of the machine only. The slots are padded, and
    // their labels, too.
    unsafe {
        match (isa, wanted.label) {
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512, None) => nearest_avx512::<false>(slots, wanted, half_m),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512, Some(_)) => nearest_avx512::<true>(slots, wanted, half_m),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx2, None) => nearest_avx2::<false>(slots, wanted, half_m),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx2, Some(_)) => nearest_avx2::<true>(slots, wanted, half_m),
            (_, None) => nearest_in::<F32x4, false>(slots, wanted, half_m),
            (_, Some(_)) => nearest_in::<F32x4, true>(slots, wanted, half_m),
        }
    }
}

/// Calls `see` with a first slot and one bit for each of the slots from it on: whether the point of
/// the slot is less than `within_m` metres from one of `centers`, which lie near each other.
pub(super) fn each_near(
    isa: Isa,
    slots: &Slots,
    centers: &[Point],
    within_m: f32,
    see: impl FnMut(usize, u32),
) {
    // SAFETY: as in `nearest`.
    unsafe {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => each_near_avx512(slots, centers, within_m, see),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => each_near_avx2(slots, centers, within_m, see),
            _ => each_near_in::<F32x4>(slots, centers, within_m, see),
        }
    }
}

/// Calls `see` as [`each_near`], with the points of the columns that touch the square of half side
/// `half_m` around `center`, and are less than `height_m` higher or lower. Metres.
pub(super) fn each_level(
    isa: Isa,
    slots: &Slots,
    center: Point,
    [half_m, height_m]: [f32; 2],
    see: impl FnMut(usize, u32),
) {
    // SAFETY: as in `nearest`.
    unsafe {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => each_level_avx512(slots, center, half_m, height_m, see),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => each_level_avx2(slots, center, half_m, height_m, see),
            _ => each_level_in::<F32x4>(slots, center, half_m, height_m, see),
        }
    }
}

/// # Safety
/// The caller has the instruction set of `L`. A label is given for each of the padded slots.
#[inline(always)]
unsafe fn nearest_in<L: Lanes, const LABELLED: bool>(
    slots: &Slots,
    wanted: Wanted<'_>,
    half_m: f32,
) -> Option<(f32, usize)> {
    let Wanted {
        center,
        square,
        label,
    } = wanted;
    // SAFETY: the caller has the instruction set. Loads begin at slots that exist and end before
    // the padding does.
    unsafe {
        let center_lanes = center.map(|c| L::splat(c));
        let limit = L::splat(square);
        let (labels, label) = label.unwrap_or((&[], 0.0));
        let label = L::splat(label);
        let (mut least, mut first_slots) = (limit, L::splat(0.0));
        slots.tiles.each_run(around(&[center], half_m), |run| {
            let mut first = run.start;
            while first < run.end {
                let mut squares = squares_at::<L>(slots, center_lanes, first);
                if LABELLED {
                    let labels = L::load(labels.as_ptr().add(first));
                    squares = squares.where_equal(labels, label, L::splat(f32::INFINITY));
                }
                let here = L::splat(f32::from_bits(first as u32));
                first_slots = here.where_less(squares, least, first_slots);
                least = squares.min(least);
                first += L::COUNT;
            }
        });
        let best = least.least();
        if best >= square {
            return None;
        }
        let mut firsts = [0.0; MOST_LANES];
        first_slots.store(firsts.as_mut_ptr());
        let mut equals = !L::splat(best).less(least) & lowest(L::COUNT);
        let mut slot = usize::MAX;
        while equals != 0 {
            let lane = equals.trailing_zeros() as usize;
            equals &= equals - 1;
            slot = slot.min(firsts[lane].to_bits() as usize + lane);
        }
        Some((best, slot))
    }
}

/// # Safety
/// The caller has the instruction set of `L`.
#[inline(always)]
unsafe fn each_near_in<L: Lanes>(
    slots: &Slots,
    centers: &[Point],
    within_m: f32,
    mut see: impl FnMut(usize, u32),
) {
    // SAFETY: as in `nearest_in`.
    unsafe {
        let limit = L::splat(within_m * within_m);
        slots.tiles.each_run(around(centers, within_m), |run| {
            let mut first = run.start;
            while first < run.end {
                let wanted = lowest(L::COUNT.min(run.end - first));
                let mut bits = 0;
                for center in centers {
                    let center = center.map(|c| L::splat(c));
                    bits |= squares_at::<L>(slots, center, first).less(limit) & wanted;
                    if bits == wanted {
                        break;
                    }
                }
                if bits != 0 {
                    see(first, bits);
                }
                first += L::COUNT;
            }
        });
    }
}

/// # Safety
/// The caller has the instruction set of `L`.
#[inline(always)]
unsafe fn each_level_in<L: Lanes>(
    slots: &Slots,
    center: Point,
    half_m: f32,
    height_m: f32,
    mut see: impl FnMut(usize, u32),
) {
    // SAFETY: as in `nearest_in`.
    unsafe {
        let [low, high] = [center[2] - height_m, center[2] + height_m].map(|z| L::splat(z));
        slots.tiles.each_run(around(&[center], half_m), |run| {
            let mut first = run.start;
            while first < run.end {
                let heights = L::load(slots.axes[2].as_ptr().add(first));
                let bits = low.less(heights) & heights.less(high) & lowest(run.end - first);
                if bits != 0 {
                    see(first, bits);
                }
                first += L::COUNT;
            }
        });
    }
}

/// Squared distances of a register of points from the slot `first` on.
///
/// # Safety
/// The caller has the instruction set of `L`, and the slot exists.
#[inline(always)]
unsafe fn squares_at<L: Lanes>(slots: &Slots, center: [L; 3], first: usize) -> L {
    debug_assert!(first + MOST_LANES <= slots.padded());
    // SAFETY: the caller has the instruction set. At least `MOST_LANES` floats follow every slot.
    unsafe {
        let away = |axis: usize| {
            let away = center[axis].sub(L::load(slots.axes[axis].as_ptr().add(first)));
            away.mul(away)
        };
        away(0).add(away(1)).add(away(2))
    }
}

/// The corners of the rectangle that reaches `within_m` beyond all of `centers`, along x and y.
#[inline(always)]
fn around(centers: &[Point], within_m: f32) -> [[f32; 2]; 2] {
    let mut corners = [[f32::INFINITY; 2], [f32::NEG_INFINITY; 2]];
    for center in centers {
        for axis in 0..2 {
            corners[0][axis] = corners[0][axis].min(center[axis] - within_m);
            corners[1][axis] = corners[1][axis].max(center[axis] + within_m);
        }
    }
    corners
}

/// The lowest `count` bits.
#[inline(always)]
fn lowest(count: usize) -> u32 {
    (1 << count.min(MOST_LANES)) - 1
}

/// The kernels compiled for one instruction set.
#[cfg(target_arch = "x86_64")]
macro_rules! compiled {
    ($features:literal, $lanes:ty, $nearest:ident, $each_near:ident, $each_level:ident) => {
        #[target_feature(enable = $features)]
        unsafe fn $nearest<const LABELLED: bool>(
            slots: &Slots,
            wanted: Wanted<'_>,
            half_m: f32,
        ) -> Option<(f32, usize)> {
            // SAFETY: the features are enabled; the rest is the caller's.
            unsafe { nearest_in::<$lanes, LABELLED>(slots, wanted, half_m) }
        }
        #[target_feature(enable = $features)]
        unsafe fn $each_near(
            slots: &Slots,
            centers: &[Point],
            within_m: f32,
            see: impl FnMut(usize, u32),
        ) {
            // SAFETY: the features are enabled.
            unsafe { each_near_in::<$lanes>(slots, centers, within_m, see) }
        }
        #[target_feature(enable = $features)]
        unsafe fn $each_level(
            slots: &Slots,
            center: Point,
            half_m: f32,
            height_m: f32,
            see: impl FnMut(usize, u32),
        ) {
            // SAFETY: the features are enabled.
            unsafe { each_level_in::<$lanes>(slots, center, half_m, height_m, see) }
        }
    };
}

#[cfg(target_arch = "x86_64")]
compiled!(
    "avx512f,popcnt",
    F32x16,
    nearest_avx512,
    each_near_avx512,
    each_level_avx512
);
#[cfg(target_arch = "x86_64")]
compiled!(
    "avx2,fma,popcnt",
    F32x8,
    nearest_avx2,
    each_near_avx2,
    each_level_avx2
);
