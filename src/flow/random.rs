//! stub replaced on merge
use rand_core::{Rng, SeedableRng};
pub(crate) struct Random(rand_pcg::Pcg64Mcg);
impl Random {
    pub(crate) fn new(seed: u64) -> Self { Self(rand_pcg::Pcg64Mcg::seed_from_u64(seed)) }
    pub(crate) fn uniform(&mut self, lo: f64, hi: f64) -> f64 { let u = (self.0.next_u64() >> 11) as f64 / (1u64 << 53) as f64; lo + u * (hi - lo) }
    pub(crate) fn below(&mut self, n: usize) -> usize { (self.uniform(0.0, 1.0) * n as f64) as usize }
    pub(crate) fn shuffle<T>(&mut self, items: &mut [T]) { for i in (1..items.len()).rev() { let j = self.below(i + 1); items.swap(i, j); } }
}
