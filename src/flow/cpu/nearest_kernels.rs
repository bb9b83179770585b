//! The kernels of the brute-force nearest neighbor search: all squared distances between a group of
//! queries and a cloud.
//!
//! The lanes of a register hold queries, and the coordinates of one site are broadcast to all of
//! them: seven vector operations for the distances of a register of queries to a site. The minimum
//! alone is tracked within a block of sites. The position within the best block is found at the
//! end.
#![expect(
    unsafe_code,
    reason = "calls into code compiled for instruction sets that were checked"
)]

use crate::flow::data::Point;
use crate::flow::field::Aligned;
use crate::flow::simd::Isa;
use crate::flow::simd::{F32x4, Lanes};
#[cfg(target_arch = "x86_64")]
use crate::flow::simd::{F32x8, F32x16};

/// Queries of one call of the kernel: four registers of AVX-512.
pub(super) const QUERIES: usize = 64;
/// Sites of a block.
const BLOCK: usize = 32;
/// Coordinate of the sites that fill the last block: infinitely far.
const FAR: f32 = f32::INFINITY;

/// A cloud in separate arrays of coordinates, padded to whole blocks.
pub(super) struct Sites([Aligned; 3]);

impl Sites {
    /// The sites `points`, metres.
    pub(super) fn new(points: &[Point]) -> Self {
        let padded = points.len().next_multiple_of(BLOCK);
        let axis = |axis: usize| {
            let mut floats = Aligned::zeros(padded);
            let slice = floats.as_mut_slice();
            for (float, point) in slice.iter_mut().zip(points) {
                *float = point[axis];
            }
            slice[points.len()..].fill(FAR);
            floats
        };
        Self([axis(0), axis(1), axis(2)])
    }

    fn axes(&self) -> [&[f32]; 3] {
        [0, 1, 2].map(|axis| self.0[axis].as_slice())
    }
}

type Search = unsafe fn(&[[f32; QUERIES]; 3], [&[f32]; 3], &mut [u32; QUERIES]);

/// The search of one instruction set.
#[derive(Clone, Copy)]
pub(super) struct NearestKernel(Search);

impl NearestKernel {
    /// The kernel of `isa`.
    ///
    /// # Panics
    /// If the machine lacks the instruction set.
    pub(super) fn new(isa: Isa) -> Self {
        assert!(Isa::available().contains(&isa), "{isa:?} is not available");
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => Self(search_avx512),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => Self(search_avx2),
            _ => Self(search_portable),
        }
    }

    /// Writes the index of the site nearest to each of up to [`QUERIES`] queries to `nearest`. Of
    /// equally near sites it is the first. There must be at least one site. The index of a query
    /// that is not finite is that of any site.
    pub(super) fn search(&self, queries: &[Point], sites: &Sites, nearest: &mut [u32]) {
        let mut axes = [[0.0; QUERIES]; 3];
        for (row, query) in queries.iter().enumerate() {
            for (axis, &value) in axes.iter_mut().zip(query) {
                axis[row] = value;
            }
        }
        let mut found = [0; QUERIES];
        // SAFETY: `new` checked the instruction set.
        unsafe { (self.0)(&axes, sites.axes(), &mut found) };
        nearest.copy_from_slice(&found[..queries.len()]);
    }
}

/// Squared distance from a register of queries to one site or, with the roles exchanged, from a
/// register of sites to one query.
///
/// # Safety
/// The caller has the instruction set of `L`.
#[inline(always)]
unsafe fn squared<L: Lanes>(a: [L; 3], b: [L; 3]) -> L {
    // SAFETY: as for this function.
    unsafe {
        let [x, y, z] = [a[0].sub(b[0]), a[1].sub(b[1]), a[2].sub(b[2])];
        x.mul_add(x, y.mul_add(y, z.mul_add(z, L::splat(0.0))))
    }
}

/// The search, `REGISTERS` registers of queries at a time.
///
/// # Safety
/// The caller has the instruction set of `L`. The arrays of `sites` have the same length, a
/// multiple of [`BLOCK`].
#[inline(always)]
unsafe fn search<L: Lanes, const REGISTERS: usize>(
    queries: &[[f32; QUERIES]; 3],
    sites: [&[f32]; 3],
    nearest: &mut [u32; QUERIES],
) {
    let [xs, ys, zs] = sites;
    for first in (0..QUERIES).step_by(REGISTERS * L::COUNT) {
        let mut blocks = [0.0f32; QUERIES];
        // SAFETY: the caller has the instruction set, and `first` and the registers after it lie
        // within the queries.
        unsafe {
            let own: [[L; 3]; REGISTERS] = core::array::from_fn(|register| {
                [0, 1, 2].map(|a| L::load(queries[a].as_ptr().add(first + register * L::COUNT)))
            });
            let mut best = [L::splat(f32::INFINITY); REGISTERS];
            let mut best_block = [L::splat(0.0); REGISTERS];
            let blocks_of_sites = xs
                .chunks_exact(BLOCK)
                .zip(ys.chunks_exact(BLOCK))
                .zip(zs.chunks_exact(BLOCK));
            for (number, ((xs, ys), zs)) in blocks_of_sites.enumerate() {
                let mut least = [L::splat(f32::INFINITY); REGISTERS];
                for site in 0..BLOCK {
                    let site = [L::splat(xs[site]), L::splat(ys[site]), L::splat(zs[site])];
                    for register in 0..REGISTERS {
                        let distance = squared(own[register], site);
                        least[register] = distance.min(least[register]);
                    }
                }
                let number = L::splat(number as f32);
                for register in 0..REGISTERS {
                    let (new, old) = (least[register], best[register]);
                    best_block[register] = number.where_less(new, old, best_block[register]);
                    best[register] = new.min(old);
                }
            }
            for (register, block) in best_block.into_iter().enumerate() {
                block.store(blocks.as_mut_ptr().add(first + register * L::COUNT));
            }
        }
        for row in first..first + REGISTERS * L::COUNT {
            let start = blocks[row] as usize * BLOCK;
            let block = [xs, ys, zs].map(|axis| &axis[start..start + BLOCK]);
            let query = [0, 1, 2].map(|a| queries[a][row]);
            // SAFETY: the caller has the instruction set, and the slices have a block's length.
            nearest[row] = (start + unsafe { within::<L>(query, block) }) as u32;
        }
    }
}

/// The position of the first nearest site in a block.
///
/// # Safety
/// The caller has the instruction set of `L`, and the slices have [`BLOCK`] floats.
#[inline(always)]
unsafe fn within<L: Lanes>(query: Point, block: [&[f32]; 3]) -> usize {
    let mut distances = [0.0f32; BLOCK];
    // SAFETY: the caller has the instruction set, and a block is a whole number of registers.
    unsafe {
        let query = query.map(|value| L::splat(value));
        for first in (0..BLOCK).step_by(L::COUNT) {
            let site = block.map(|axis| L::load(axis.as_ptr().add(first)));
            squared(query, site).store(distances.as_mut_ptr().add(first));
        }
    }
    let (mut position, mut least) = (0, distances[0]);
    for (other, &distance) in distances.iter().enumerate() {
        if distance < least {
            (position, least) = (other, distance);
        }
    }
    position
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn search_avx512(q: &[[f32; QUERIES]; 3], sites: [&[f32]; 3], n: &mut [u32; QUERIES]) {
    // SAFETY: avx512f is enabled.
    unsafe { search::<F32x16, 4>(q, sites, n) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn search_avx2(q: &[[f32; QUERIES]; 3], sites: [&[f32]; 3], n: &mut [u32; QUERIES]) {
    // SAFETY: avx2 and fma are enabled.
    unsafe { search::<F32x8, 2>(q, sites, n) }
}
unsafe fn search_portable(q: &[[f32; QUERIES]; 3], sites: [&[f32]; 3], n: &mut [u32; QUERIES]) {
    // SAFETY: plain Rust needs no CPU feature.
    unsafe { search::<F32x4, 2>(q, sites, n) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;

    fn points(count: usize, seed: u64) -> Vec<Point> {
        let mut random = Random::new(seed);
        let mut point = || core::array::from_fn(|_| random.uniform(-60.0, 60.0) as f32);
        (0..count).map(|_| point()).collect()
    }

    fn squared_f64(a: Point, b: Point) -> f64 {
        (0..3)
            .map(|axis| (f64::from(a[axis]) - f64::from(b[axis])).powi(2))
            .sum()
    }

    #[test]
    fn every_instruction_set_finds_the_nearest_site_at_awkward_counts() {
        // Rounding of single-precision differences and sums, relative to the squared distance.
        const TOLERANCE: f64 = 1e-6;
        for isa in Isa::available() {
            let kernel = NearestKernel::new(isa);
            for (queries, sites) in [(1, 1), (63, 31), (64, 32), (5, 33), (64, 1000)] {
                let (queries, cloud) = (points(queries, 1), points(sites, 2));
                let mut nearest = vec![u32::MAX; queries.len()];
                kernel.search(&queries, &Sites::new(&cloud), &mut nearest);
                for (&query, found) in queries.iter().zip(nearest) {
                    let least = cloud.iter().map(|&site| squared_f64(query, site));
                    let least = least.fold(f64::INFINITY, f64::min);
                    let found = squared_f64(query, cloud[found as usize]);
                    assert!(
                        found <= least * (1.0 + TOLERANCE),
                        "{isa:?}, {} x {sites}: {found} {least}",
                        queries.len()
                    );
                }
            }
        }
    }

    #[test]
    fn of_equally_near_sites_the_first_is_found() {
        let cloud = [[1.0, 0.0, 0.0]; 100];
        for isa in Isa::available() {
            let mut nearest = [7; 3];
            NearestKernel::new(isa).search(&[[0.0; 3]; 3], &Sites::new(&cloud), &mut nearest);
            assert_eq!(nearest, [0; 3], "{isa:?}");
        }
    }

    #[test]
    fn a_query_that_is_not_finite_finds_a_site_that_exists() {
        let cloud = points(3, 4);
        for isa in Isa::available() {
            for bad in [f32::NAN, f32::INFINITY, 1e30] {
                let mut nearest = [9];
                let query = [[bad, 0.0, 0.0]];
                NearestKernel::new(isa).search(&query, &Sites::new(&cloud), &mut nearest);
                assert!(nearest[0] < 3, "{isa:?} {bad}: {}", nearest[0]);
            }
        }
    }
}
