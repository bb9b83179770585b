//! The random number generator of the numerics: PCG64, seeded explicitly, equal on every machine.
//!
//! It uses neither a clock nor the system's entropy.

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;

/// 2^-53: maps the top 53 bits of a word to an f64 in [0, 1) without rounding.
const UNIT: f64 = 1.0 / (1u64 << 53) as f64;

/// A seeded random stream.
///
/// `uniform`, `below` and `shuffle` give the same bits on every machine. `normal` calls the
/// platform's logarithm and may differ in the last bit between platforms.
#[derive(Debug, Clone)]
pub(crate) struct Random {
    bits: Pcg64,
    spare_normal: Option<f64>,
}

impl Random {
    /// The stream of `seed`.
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            bits: Pcg64::seed_from_u64(seed),
            spare_normal: None,
        }
    }

    /// One of many independent streams of the same seed, so that parallel parts can draw in any
    /// order.
    pub(crate) fn stream(seed: u64, stream: u64) -> Self {
        Self::new(mix(seed ^ mix(stream)))
    }

    /// A number in [lo, hi), in 2^53 equal steps.
    pub(crate) fn uniform(&mut self, lo: f64, hi: f64) -> f64 {
        let unit = (self.bits.next_u64() >> 11) as f64 * UNIT;
        lo + (hi - lo) * unit
    }

    /// A draw from the standard normal distribution, mean 0 and deviation 1 (Marsaglia's polar
    /// method).
    pub(crate) fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare_normal.take() {
            return spare;
        }
        loop {
            let (u, v) = (self.uniform(-1.0, 1.0), self.uniform(-1.0, 1.0));
            let square = u * u + v * v;
            if square > 0.0 && square < 1.0 {
                let scale = (-2.0 * square.ln() / square).sqrt();
                self.spare_normal = Some(v * scale);
                return u * scale;
            }
        }
    }

    /// An unbiased integer in 0..n (Lemire's method); 0 if n is 0.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        let n = n as u64;
        if n == 0 {
            return 0;
        }
        let unfair = n.wrapping_neg() % n;
        loop {
            let wide = u128::from(self.bits.next_u64()) * u128::from(n);
            if wide as u64 >= unfair {
                return (wide >> 64) as usize;
            }
        }
    }

    /// Shuffles the items; every order is equally likely.
    pub(crate) fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            items.swap(last, self.below(last + 1));
        }
    }
}

/// Spreads a small number over all 64 bits (the finalizer of splitmix64).
fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    const DRAWS: usize = 100_000;

    #[test]
    fn the_first_values_of_a_seed_are_pinned() {
        let mut random = Random::new(7);
        let bits: Vec<u64> = (0..3).map(|_| random.bits.next_u64()).collect();
        let pinned = [
            9_351_779_398_707_215,
            4_267_278_794_321_568_333,
            16_631_418_469_999_051_220,
        ];
        assert_eq!(bits, pinned);
        let below: Vec<usize> = (0..6).map(|_| random.below(1000)).collect();
        assert_eq!(below, [835, 491, 591, 89, 323, 616]);
        let mut order: Vec<usize> = (0..8).collect();
        random.shuffle(&mut order);
        assert_eq!(order, [6, 3, 0, 5, 2, 7, 1, 4]);
        let stream = Random::stream(7, 1).uniform(0.0, 1.0);
        assert_eq!(stream.to_bits(), 4_597_332_837_379_793_804);
    }

    #[test]
    fn uniform_numbers_fill_their_interval_evenly() {
        let mut random = Random::new(1);
        let mut bins = [0usize; 10];
        for _ in 0..DRAWS {
            let value = random.uniform(-2.0, 3.0);
            assert!((-2.0..3.0).contains(&value));
            bins[((value + 2.0) * 2.0) as usize] += 1;
        }
        // Five standard deviations of a binomial count of mean 10,000.
        assert!(
            bins.iter().all(|&n| n.abs_diff(DRAWS / 10) < 500),
            "{bins:?}"
        );
    }

    #[test]
    fn normal_numbers_have_the_moments_of_the_normal_distribution() {
        let mut random = Random::new(2);
        let values: Vec<f64> = (0..DRAWS).map(|_| random.normal()).collect();
        let moment = |power: i32| values.iter().map(|v| v.powi(power)).sum::<f64>() / DRAWS as f64;
        // Five standard errors of each moment for this number of draws.
        assert!(moment(1).abs() < 0.016);
        assert!((moment(2) - 1.0).abs() < 0.023);
        assert!((moment(4) - 3.0).abs() < 0.16);
    }

    #[test]
    fn below_reaches_every_number_and_no_other() {
        let mut random = Random::new(3);
        let mut bins = [0usize; 7];
        for _ in 0..DRAWS {
            bins[random.below(7)] += 1;
        }
        assert!(
            bins.iter().all(|&n| n.abs_diff(DRAWS / 7) < 600),
            "{bins:?}"
        );
        assert_eq!((random.below(0), random.below(1)), (0, 0));
    }

    #[test]
    fn streams_of_a_seed_are_unrelated() {
        let firsts = |seed| (0..1000).map(move |s| Random::stream(seed, s).uniform(0.0, 1.0));
        let mean = firsts(9).sum::<f64>() / 1000.0;
        assert!((mean - 0.5).abs() < 0.05, "{mean}");
        assert!(firsts(9).zip(firsts(10)).all(|(a, b)| a != b));
    }
}
