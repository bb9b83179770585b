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

/// Factor on a radius that covers its rounding.
const ROUNDED_UP: f32 = 1.0 + 4.0 * f32::EPSILON;

/// The points that a search may find.
#[derive(Clone, Copy)]
pub(super) struct Wanted<'a> {
    pub(super) center: Point,
    /// Distance that a point must be below, metres.
    pub(super) within_m: f32,
    /// A label for each slot, and the label that a point must have.
    pub(super) label: Option<(&'a [f32], f32)>,
}

/// The slot and the squared distance of the nearest point. Of equally near points it is the one of
/// the lowest slot.
#[inline]
pub(super) fn nearest(isa: Isa, slots: &Slots, wanted: Wanted<'_>) -> Option<(usize, f32)> {
    if let Some((labels, _)) = wanted.label {
        assert_eq!(labels.len(), slots.padded());
    }
    // SAFETY: an index takes an instruction set of the machine only. The slots are padded, and
    // their labels, too.
    unsafe {
        match (isa, wanted.label) {
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512, None) => nearest_avx512::<false>(slots, wanted),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx512, Some(_)) => nearest_avx512::<true>(slots, wanted),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx2, None) => nearest_avx2::<false>(slots, wanted),
            #[cfg(target_arch = "x86_64")]
            (Isa::Avx2, Some(_)) => nearest_avx2::<true>(slots, wanted),
            (_, None) => nearest_in::<F32x4, false>(slots, wanted),
            (_, Some(_)) => nearest_in::<F32x4, true>(slots, wanted),
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
) -> Option<(usize, f32)> {
    let Wanted {
        center,
        within_m,
        label,
    } = wanted;
    // The columns within half a side are at most four, and hold the nearest point of most searches.
    let half_m = 0.5 * slots.tiles.column_m();
    let mut is_last = half_m >= within_m;
    let mut reach_m = if is_last { within_m } else { half_m };
    // SAFETY: the caller has the instruction set. Loads begin at slots that exist and end before
    // the padding does.
    unsafe {
        let center_lanes = splat::<L>(center);
        let limit = L::splat(within_m * within_m);
        let (labels, label) = label.unwrap_or((&[], 0.0));
        let label = L::splat(label);
        loop {
            let (mut least, mut first_slots) = (limit, L::splat(0.0));
            slots.tiles.each_run(square_around(center, reach_m), |run| {
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
            // All points nearer than the reach were looked at.
            if best < reach_m * reach_m || is_last {
                let is_found = best < within_m * within_m;
                return is_found.then(|| (lowest_slot(least, best, first_slots), best));
            }
            reach_m = (best.sqrt() * ROUNDED_UP).min(within_m);
            is_last = true;
        }
    }
}

/// The lowest of the slots whose squared distance is `best`, the least one. Slots are counted from
/// the first one of their register.
///
/// # Safety
/// The caller has the instruction set of `L`.
#[inline(always)]
unsafe fn lowest_slot<L: Lanes>(squares: L, best: f32, first_slots: L) -> usize {
    let mut firsts = [0.0; MOST_LANES];
    // SAFETY: the caller has the instruction set, and a register fits.
    let mut equals = unsafe {
        first_slots.store(firsts.as_mut_ptr());
        !L::splat(best).less(squares) & lowest(L::COUNT)
    };
    let mut slot = usize::MAX;
    while equals != 0 {
        let lane = equals.trailing_zeros() as usize;
        equals &= equals - 1;
        slot = slot.min(firsts[lane].to_bits() as usize + lane);
    }
    slot
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
        slots
            .tiles
            .each_run(around(centers.iter().copied(), within_m), |run| {
                let mut first = run.start;
                while first < run.end {
                    let wanted = lowest(L::COUNT.min(run.end - first));
                    let mut bits = 0;
                    for center in centers {
                        let center = splat::<L>(*center);
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
        slots.tiles.each_run(square_around(center, half_m), |run| {
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
    // SAFETY: the caller's.
    unsafe { squares_of(away_at(slots, center, first)) }
}

/// Offsets of `center` from a register of points from the slot `first` on.
///
/// # Safety
/// As [`squares_at`].
#[inline(always)]
pub(super) unsafe fn away_at<L: Lanes>(slots: &Slots, center: [L; 3], first: usize) -> [L; 3] {
    debug_assert!(first + MOST_LANES <= slots.padded());
    let [x, y, z] = center;
    // SAFETY: the caller has the instruction set. At least `MOST_LANES` floats follow every slot.
    unsafe {
        let axis = |axis: usize| L::load(slots.axes[axis].as_ptr().add(first));
        [x.sub(axis(0)), y.sub(axis(1)), z.sub(axis(2))]
    }
}

/// Squares of the lengths of offsets.
///
/// # Safety
/// The caller has the instruction set of `L`.
#[inline(always)]
pub(super) unsafe fn squares_of<L: Lanes>([x, y, z]: [L; 3]) -> L {
    // SAFETY: the caller has the instruction set.
    unsafe { x.mul(x).add(y.mul(y)).add(z.mul(z)) }
}

/// A register of each coordinate.
///
/// # Safety
/// The caller has the instruction set of `L`.
#[inline(always)]
pub(super) unsafe fn splat<L: Lanes>([x, y, z]: Point) -> [L; 3] {
    // SAFETY: the caller has the instruction set.
    unsafe { [L::splat(x), L::splat(y), L::splat(z)] }
}

/// The corners of the square of half side `half_m` around `center`, along x and y.
#[inline(always)]
pub(super) fn square_around([x, y, _]: Point, half_m: f32) -> [[f32; 2]; 2] {
    [[x - half_m, y - half_m], [x + half_m, y + half_m]]
}

/// The corners of the rectangle that reaches `within_m` beyond all of `centers`, along x and y, metres.
#[inline(always)]
pub(crate) fn around(centers: impl IntoIterator<Item = Point>, within_m: f32) -> [[f32; 2]; 2] {
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
        ) -> Option<(usize, f32)> {
            // SAFETY: the features are enabled; the rest is the caller's.
            unsafe { nearest_in::<$lanes, LABELLED>(slots, wanted) }
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
