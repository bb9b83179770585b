//! Workloads for benchmarks: the network's kernels, and the multiply-add peak of one thread.
//!
//! Each workload returns its number of floating-point operations; the caller measures the time.
//! Used by the benchmarks and by `fnsf doctor`.
#![expect(
    unsafe_code,
    reason = "the peak is measured with the same registers as the kernels"
)]

use super::kernels::Kernels;
use crate::flow::simd::Isa;
use crate::flow::simd::{F32x4, Lanes};

use super::tile::{TILE, Tile};
use crate::flow::data::{Point, Random};
use crate::flow::field::{MIDDLE_LAYERS, Parameters, WIDTH, mlp, transpose_middle_layers};
#[cfg(target_arch = "x86_64")]
use crate::flow::simd::{F32x8, F32x16};

/// Floating-point operations of the forward pass per point.
const FORWARD: usize = 2 * (3 * WIDTH + MIDDLE_LAYERS * WIDTH * WIDTH + 3 * WIDTH);
/// Floating-point operations of the backward pass per point: those of the forward pass for the
/// weights, and again for the inputs of every layer but the first.
const BACKWARD: usize = 2 * FORWARD - 2 * 3 * WIDTH;

/// A benchmark of the network's kernels: a random network and a random cloud, processed by the
/// calling thread. The caller measures the time.
pub struct NetworkWorkload {
    kernels: Kernels,
    parameters: Parameters,
    transposed: Parameters,
    gradients: Parameters,
    tile: Tile,
    points: Vec<Point>,
}

impl NetworkWorkload {
    /// A random network and `points` random points, for the kernels of `isa`. The seed is fixed, so
    /// every call gives the same network and the same points.
    ///
    /// # Panics
    /// If `isa` is not one of [`Isa::available`].
    pub fn new(isa: Isa, points: usize) -> Self {
        let mut random = Random::new(1);
        let parameters = mlp::xavier(&mut random);
        let mut transposed = mlp::zeros();
        transpose_middle_layers(parameters.as_slice(), transposed.as_mut_slice());
        let mut point = || core::array::from_fn(|_| random.uniform(-1.0, 1.0) as f32);
        Self {
            kernels: Kernels::new(isa),
            points: (0..points).map(|_| point()).collect(),
            parameters,
            transposed,
            gradients: mlp::zeros(),
            tile: Tile::new(),
        }
    }

    /// Runs the forward pass over all points. Returns the number of floating-point operations of
    /// its matrix products, two per multiply-add.
    pub fn forward(&mut self) -> f64 {
        for points in self.points.chunks(TILE) {
            self.tile.load(points.iter().copied());
            self.kernels
                .forward(self.parameters.as_slice(), &mut self.tile);
        }
        (self.points.len() * FORWARD) as f64
    }

    /// Runs the forward and backward passes over all points. Returns the number of floating-point
    /// operations of their matrix products, two per multiply-add.
    pub fn forward_and_backward(&mut self) -> f64 {
        for points in self.points.chunks(TILE) {
            self.tile.load(points.iter().copied());
            self.kernels
                .forward(self.parameters.as_slice(), &mut self.tile);
            self.tile.output_gradients[..points.len()].fill([0.1, -0.2, 0.3]);
            self.kernels.backward(
                self.parameters.as_slice(),
                self.transposed.as_slice(),
                &mut self.tile,
                self.gradients.as_mut_slice(),
            );
        }
        (self.points.len() * (FORWARD + BACKWARD)) as f64
    }
}

/// Benchmark of the peak arithmetic throughput of one thread.
///
/// Runs `rounds` rounds of 12 independent multiply-adds on full vector registers of `isa`, on the
/// calling thread. Returns the number of floating-point operations: two for each element of a
/// register in each multiply-add. The caller measures the time. The number over the time in seconds
/// is the peak in operations per second.
///
/// # Panics
/// If `isa` is not one of [`Isa::available`].
pub fn multiply_add_peak(isa: Isa, rounds: usize) -> f64 {
    assert!(Isa::available().contains(&isa), "{isa:?} is not available");
    // SAFETY: the assertion checked the instruction set.
    unsafe {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => peak_avx512(rounds),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => peak_avx2(rounds),
            _ => peak::<F32x4>(rounds),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn peak_avx512(rounds: usize) -> f64 {
    // SAFETY: avx512f is enabled.
    unsafe { peak::<F32x16>(rounds) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn peak_avx2(rounds: usize) -> f64 {
    // SAFETY: avx2 and fma are enabled.
    unsafe { peak::<F32x8>(rounds) }
}

#[inline(always)]
unsafe fn peak<L: Lanes>(rounds: usize) -> f64 {
    const CHAINS: usize = 12;
    // SAFETY: the caller has enabled the instruction set.
    unsafe {
        let factor = L::splat(core::hint::black_box(0.999));
        let addend = L::splat(core::hint::black_box(0.001));
        let mut chains = [factor; CHAINS];
        for _ in 0..rounds {
            for chain in &mut chains {
                *chain = chain.mul_add(factor, addend);
            }
        }
        let sum = chains.into_iter().fold(addend, |sum, chain| sum.add(chain));
        let mut kept = [0.0; 16];
        sum.store(kept.as_mut_ptr());
        core::hint::black_box(kept);
    }
    (rounds * CHAINS * L::COUNT * 2) as f64
}
