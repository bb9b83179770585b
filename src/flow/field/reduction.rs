//! The fixed order of an iteration's sums: gradients chunk by chunk, losses tile by tile.
//!
//! Single-precision sums depend on their order. This order depends on the number of points alone,
//! and every backend uses it. The result therefore has the same bits for any number of threads, any
//! register width and any GPU, as far as they round a multiply-add alike.

use core::ops::Range;

/// Chunks hold a multiple of this number of points, which itself is a multiple of every backend's
/// tile.
pub(crate) const STRETCH: usize = 192;
/// The most points of a chunk.
pub(crate) const MOST_POINTS: usize = 42 * STRETCH;
/// The most chunks of a batch of usual size, so that adding them takes little time beside computing
/// them.
const USUAL_CHUNKS: usize = 32;

/// The division of a batch into chunks. A chunk's points are summed in order, and then the chunks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Chunks {
    stretches: usize,
    pub(crate) count: usize,
}

impl Chunks {
    /// Divides a batch of at most `points` points. A small batch gets enough chunks for two threads
    /// to share it. A large batch gets chunks of more points.
    pub(crate) fn new(points: usize) -> Self {
        let stretches = points.div_ceil(STRETCH).max(1);
        let usual = stretches.div_ceil(2).min(8 + stretches / 6);
        Self {
            stretches,
            count: usual
                .min(USUAL_CHUNKS)
                .max(stretches.div_ceil(MOST_POINTS / STRETCH)),
        }
    }

    /// A batch of `points` points in one chunk of any size.
    #[cfg(feature = "gpu")]
    pub(crate) fn one(points: usize) -> Self {
        Self {
            stretches: points.div_ceil(STRETCH).max(1),
            count: 1,
        }
    }

    /// The points of a chunk. The range may extend beyond the end of the batch.
    pub(crate) fn points(&self, chunk: usize) -> Range<usize> {
        let first = |chunk: usize| chunk * self.stretches / self.count * STRETCH;
        first(chunk)..first(chunk + 1)
    }
}

/// Losses that are first summed by a tree, and the number of partial sums of such tiles.
const TILE: usize = 64;
const SIDE_BY_SIDE: usize = 256;

/// The mean of an iteration's losses.
pub(crate) fn mean(losses: &[f32]) -> f32 {
    sum(losses) * (1.0 / losses.len() as f32)
}

/// The sum of `terms`.
pub(crate) fn sum(terms: &[f32]) -> f32 {
    let mut sums = [0.0; SIDE_BY_SIDE];
    for (tile, terms) in terms.chunks(TILE).enumerate() {
        let mut padded = [0.0; TILE];
        padded[..terms.len()].copy_from_slice(terms);
        sums[tile % SIDE_BY_SIDE] += tree_sum(padded);
    }
    tree_sum(sums)
}

/// Tree sum of `N` terms, a power of two: the upper half is added to the lower half until one
/// remains.
#[inline(always)]
pub(crate) fn tree_sum<const N: usize>(mut terms: [f32; N]) -> f32 {
    let mut half = N / 2;
    while half > 0 {
        for i in 0..half {
            terms[i] += terms[i + half];
        }
        half /= 2;
    }
    terms[0]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_point_is_in_one_chunk_and_no_chunk_is_too_large() {
        for points in [1, 191, 192, 193, 2048, 8192, 90_000, 150_000, 2_000_000] {
            let chunks = Chunks::new(points);
            let mut next = 0;
            for chunk in 0..chunks.count {
                let own = chunks.points(chunk);
                assert_eq!(own.start, next);
                assert!(!own.is_empty() && own.len() <= MOST_POINTS, "{own:?}");
                next = own.end;
            }
            assert_eq!(next, points.next_multiple_of(STRETCH));
        }
        let counts = [2048, 8192, 90_000].map(|points| Chunks::new(points).count);
        assert_eq!(counts, [6, 15, 32]);
    }

    #[test]
    fn a_mean_is_the_one_in_double_precision_but_for_rounding() {
        const TOLERANCE: f64 = 1e-6;
        let losses: Vec<f32> = (0..100_001).map(|i| (i % 97) as f32 * 0.01).collect();
        for count in [1, 63, 64, 65, 5000, losses.len()] {
            let losses = &losses[..count];
            let sum: f64 = losses.iter().map(|&loss| f64::from(loss)).sum();
            let expected = sum / count as f64;
            let off = (f64::from(mean(losses)) - expected).abs();
            assert!(off <= TOLERANCE * expected.max(1.0), "{count}: {off}");
        }
    }

    #[test]
    fn halves_are_added_from_the_upper_to_the_lower() {
        // In this order the small terms survive; summed one after the other they would be lost.
        let small = f32::EPSILON / 2.0;
        assert_eq!(tree_sum([1.0, small, 0.0, small]), 1.0 + f32::EPSILON);
        assert_eq!(tree_sum([2.5]), 2.5);
    }
}
