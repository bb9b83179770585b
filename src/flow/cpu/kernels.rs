//! The fused network kernels: forward and backward passes through all layers over one tile of
//! points.
//!
//! A tile stays in the second-level cache from the first layer to the last gradient. The weights
//! are read in panels that fit the first-level cache. The kernels are compiled for AVX-512, AVX2 +
//! FMA and plain Rust. The instruction set is chosen at run time.
#![expect(
    unsafe_code,
    reason = "calls into code compiled for instruction sets that were checked"
)]

use super::mlp_kernels::{backward, forward};
use crate::flow::simd::F32x4;
use crate::flow::simd::Isa;

use super::tile::Tile;
use crate::flow::field::LAID_OUT;
#[cfg(target_arch = "x86_64")]
use crate::flow::simd::{F32x8, F32x16};

type Forward = unsafe fn(&[f32], &mut Tile);
type Backward = unsafe fn(&[f32], &[f32], &mut Tile, &mut [f32]);

/// The kernels of one instruction set.
#[derive(Clone, Copy)]
pub(crate) struct Kernels {
    forward: Forward,
    backward: Backward,
}

impl Kernels {
    /// The kernels of `isa`.
    ///
    /// # Panics
    /// If the machine lacks the instruction set.
    pub(crate) fn new(isa: Isa) -> Self {
        assert!(Isa::available().contains(&isa), "{isa:?} is not available");
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => Self {
                forward: forward_avx512,
                backward: backward_avx512,
            },
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => Self {
                forward: forward_avx2,
                backward: backward_avx2,
            },
            _ => Self {
                forward: forward_portable,
                backward: backward_portable,
            },
        }
    }

    /// `outputs = g(inputs)` for the tile's rows. Keeps the activations for [`Self::backward`].
    ///
    /// # Panics
    /// If `parameters` are not those of one network, [`LAID_OUT`] floats.
    pub(crate) fn forward(&self, parameters: &[f32], tile: &mut Tile) {
        assert_eq!(parameters.len(), LAID_OUT, "one network");
        // SAFETY: `new` checked the instruction set, and the length is that of the layout.
        unsafe { (self.forward)(parameters, tile) }
    }

    /// Adds the tile's parameter gradients to `gradients`. They follow from the tile's
    /// `output_gradients` and the activations of the last [`Self::forward`]. `transposed` holds the
    /// transposed weights of the middle layers, see
    /// [`crate::flow::field::mlp::transpose_middle_layers`].
    ///
    /// # Panics
    /// If an array is not that of one network, [`LAID_OUT`] floats.
    pub(crate) fn backward(
        &self,
        parameters: &[f32],
        transposed: &[f32],
        tile: &mut Tile,
        gradients: &mut [f32],
    ) {
        for array in [parameters, transposed, gradients] {
            assert_eq!(array.len(), LAID_OUT, "one network");
        }
        // SAFETY: `new` checked the instruction set, and the lengths are those of the layout.
        unsafe { (self.backward)(parameters, transposed, tile, gradients) }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn forward_avx512(parameters: &[f32], tile: &mut Tile) {
    // SAFETY: avx512f is enabled.
    unsafe { forward::<F32x16, 12, 2>(parameters, tile) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn backward_avx512(p: &[f32], t: &[f32], tile: &mut Tile, g: &mut [f32]) {
    // SAFETY: avx512f is enabled.
    unsafe { backward::<F32x16, 12, 8, 2>(p, t, tile, g) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn forward_avx2(parameters: &[f32], tile: &mut Tile) {
    // SAFETY: avx2 and fma are enabled.
    unsafe { forward::<F32x8, 6, 2>(parameters, tile) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn backward_avx2(p: &[f32], t: &[f32], tile: &mut Tile, g: &mut [f32]) {
    // SAFETY: avx2 and fma are enabled.
    unsafe { backward::<F32x8, 6, 2, 2>(p, t, tile, g) }
}
unsafe fn forward_portable(parameters: &[f32], tile: &mut Tile) {
    // SAFETY: plain Rust needs no CPU feature.
    unsafe { forward::<F32x4, 6, 2>(parameters, tile) }
}
unsafe fn backward_portable(p: &[f32], t: &[f32], tile: &mut Tile, g: &mut [f32]) {
    // SAFETY: plain Rust needs no CPU feature.
    unsafe { backward::<F32x4, 6, 2, 2>(p, t, tile, g) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;
    use crate::flow::field::{
        MIDDLE_LAYERS, Parameters, ReferenceNetwork, WIDTH, middle_layer, mlp,
        transpose_middle_layers,
    };

    /// Rounding error of single-precision sums of 128 and of 96 terms, through eight layers.
    const TOLERANCE: f64 = 2e-5;
    /// Row counts around a register tile and a tile, and zero.
    const ROWS: [usize; 8] = [0, 1, 5, 11, 12, 13, 95, 96];

    fn network() -> Parameters {
        let mut random = Random::new(7);
        let mut parameters = mlp::xavier(&mut random);
        for layer in 0..MIDDLE_LAYERS {
            let bias = middle_layer(layer).bias;
            for b in &mut parameters.as_mut_slice()[bias..bias + WIDTH] {
                *b = random.uniform(-0.1, 0.1) as f32;
            }
        }
        parameters
    }

    fn points(rows: usize, seed: u64) -> Vec<[f32; 3]> {
        let mut random = Random::new(seed);
        let mut point = || core::array::from_fn(|_| random.uniform(-3.0, 3.0) as f32);
        (0..rows).map(|_| point()).collect()
    }

    /// The largest difference, divided by the largest reference value.
    fn worst(values: &[f64], reference: &[f64]) -> f64 {
        assert!(values.iter().all(|v| v.is_finite()), "not finite");
        let scale = reference.iter().fold(1e-12f64, |a, r| a.max(r.abs()));
        let difference = |(v, r): (&f64, &f64)| (v - r).abs() / scale;
        values
            .iter()
            .zip(reference)
            .map(difference)
            .fold(0.0, f64::max)
    }

    #[test]
    fn every_instruction_set_computes_the_network_at_awkward_row_counts() {
        let parameters = network();
        let reference = ReferenceNetwork::read(parameters.as_slice());
        for isa in Isa::available() {
            let mut tile = Tile::new();
            for rows in ROWS {
                let inputs = points(rows, 11);
                tile.load(inputs.iter().copied());
                Kernels::new(isa).forward(parameters.as_slice(), &mut tile);
                let values: Vec<f64> = tile.outputs[..rows]
                    .iter()
                    .flatten()
                    .map(|&x| f64::from(x))
                    .collect();
                let expected: Vec<f64> = inputs
                    .iter()
                    .flat_map(|x| reference.forward(x.map(f64::from)))
                    .collect();
                let error = worst(&values, &expected);
                assert!(error < TOLERANCE, "{isa:?}, {rows} rows: {error}");
            }
        }
    }

    #[test]
    fn every_instruction_set_computes_every_gradient_at_awkward_row_counts() {
        let parameters = network();
        let reference = ReferenceNetwork::read(parameters.as_slice());
        let mut transposed = mlp::zeros();
        transpose_middle_layers(parameters.as_slice(), transposed.as_mut_slice());
        for isa in Isa::available() {
            let kernels = Kernels::new(isa);
            let mut tile = Tile::new();
            for rows in ROWS {
                let (inputs, pulls) = (points(rows, 12), points(rows, 13));
                let mut gradients = mlp::zeros();
                let mut expected = ReferenceNetwork::read(gradients.as_slice());
                tile.load(inputs.iter().copied());
                kernels.forward(parameters.as_slice(), &mut tile);
                tile.output_gradients[..rows].copy_from_slice(&pulls);
                kernels.backward(
                    parameters.as_slice(),
                    transposed.as_slice(),
                    &mut tile,
                    gradients.as_mut_slice(),
                );
                for (input, pull) in inputs.iter().zip(&pulls) {
                    let (input, pull) = (input.map(f64::from), pull.map(f64::from));
                    reference.backward(input, pull, &mut expected);
                }
                let error = worst(
                    &ReferenceNetwork::read(gradients.as_slice()).flat(),
                    &expected.flat(),
                );
                assert!(error < TOLERANCE, "{isa:?}, {rows} rows: {error}");
            }
        }
    }

    #[test]
    fn the_reference_gradient_is_the_finite_difference_of_the_reference_network() {
        // Central differences in double precision. A step of 1e-6 crosses no ReLU kink for this
        // input.
        const STEP: f64 = 1e-6;
        let mut reference = ReferenceNetwork::read(network().as_slice());
        let (input, pull) = ([0.4, -1.3, 0.8], [0.7, -0.2, 0.5]);
        let mut gradients = ReferenceNetwork::read(mlp::zeros().as_slice());
        reference.backward(input, pull, &mut gradients);
        let value = |network: &ReferenceNetwork| -> f64 {
            network
                .forward(input)
                .iter()
                .zip(pull)
                .map(|(o, p)| o * p)
                .sum()
        };
        for (layer, output, i) in [(0, 17, 2), (1, 3, 99), (4, 120, 64), (7, 64, 5), (8, 1, 77)] {
            let weight = reference.weights[layer][output][i];
            reference.weights[layer][output][i] = weight + STEP;
            let ahead = value(&reference);
            reference.weights[layer][output][i] = weight - STEP;
            let slope = (ahead - value(&reference)) / (2.0 * STEP);
            reference.weights[layer][output][i] = weight;
            let error = (slope - gradients.weights[layer][output][i]).abs();
            assert!(error < 1e-7, "layer {layer}: {slope}");
        }
    }
}
