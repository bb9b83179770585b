//! The fused network kernels: all layers forward, then all layers backward, over one tile of points.
//!
//! A tile stays in the second-level cache from the first layer to the last gradient; weights
//! stream past it in panels that fit the first-level cache. Written once over [`Lanes`] and
//! compiled for AVX-512, AVX2 + FMA and plain Rust; the fastest that the machine has is chosen at
//! run time. Knows nothing of distances, losses or threads.
#![expect(
    unsafe_code,
    reason = "register-tiled loops over raw rows, compiled per instruction set"
)]

use super::lanes::{F32x4, Lanes};
#[cfg(target_arch = "x86_64")]
use super::lanes::{F32x8, F32x16};
use crate::flow::field::mlp::{
    Aligned, HIDDEN_LAYERS, MIDDLE_LAYERS, PANEL, Parameters, WIDTH, first_layer, last_layer,
    middle_layer,
};

/// Points in one tile: eight rows of activations of 96 points fill half of a 1 MiB cache.
pub(crate) const TILE: usize = 96;
/// Rows are padded to a multiple of this, which every kernel's row count divides.
const ROW_STEP: usize = 12;
/// Floats from one point's features to the next point's: 128 would map rows onto few cache sets.
const STRIDE: usize = WIDTH + 16;

/// An instruction set that the kernels are compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// 16 floats a register.
    Avx512,
    /// 8 floats a register, with fused multiply-add.
    Avx2,
    /// Plain Rust, on every target.
    Portable,
}

impl Isa {
    /// The instruction sets of this machine, fastest first.
    pub fn available() -> Vec<Self> {
        let mut sets = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") {
                sets.push(Self::Avx512);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                sets.push(Self::Avx2);
            }
        }
        sets.push(Self::Portable);
        sets
    }

    /// The name that reports and `fnsf doctor` show.
    pub fn name(self) -> &'static str {
        match self {
            Self::Avx512 => "AVX-512",
            Self::Avx2 => "AVX2 + FMA",
            Self::Portable => "portable",
        }
    }
}

/// The working set of one thread: a tile's inputs, activations and deltas.
pub(crate) struct Tile {
    /// Points in the tile, at most [`TILE`].
    rows: usize,
    /// Network inputs, x y z a point.
    pub(crate) inputs: [[f32; 3]; TILE],
    /// Network outputs of the last forward pass.
    pub(crate) outputs: [[f32; 3]; TILE],
    /// The loss's derivative by each output, read by the backward pass.
    pub(crate) output_gradients: [[f32; 3]; TILE],
    activations: Aligned,
    deltas: [Aligned; 2],
}

impl Tile {
    pub(crate) fn new() -> Self {
        Self {
            rows: 0,
            inputs: [[0.0; 3]; TILE],
            outputs: [[0.0; 3]; TILE],
            output_gradients: [[0.0; 3]; TILE],
            activations: Aligned::zeros(HIDDEN_LAYERS * TILE * STRIDE),
            deltas: [Aligned::zeros(TILE * STRIDE), Aligned::zeros(TILE * STRIDE)],
        }
    }

    /// Takes up to [`TILE`] inputs; the rest of the rows become zeros, with zero gradients.
    pub(crate) fn load(&mut self, inputs: impl ExactSizeIterator<Item = [f32; 3]>) {
        assert!(inputs.len() <= TILE, "a tile holds {TILE} points");
        self.rows = inputs.len();
        for (row, input) in self.inputs.iter_mut().zip(inputs) {
            *row = input;
        }
        self.inputs[self.rows..].fill([0.0; 3]);
        self.output_gradients[self.rows..].fill([0.0; 3]);
    }

    fn padded_rows(&self) -> usize {
        self.rows.next_multiple_of(ROW_STEP)
    }
}

type Forward = unsafe fn(&Parameters, &mut Tile);
type Backward = unsafe fn(&Parameters, &Parameters, &mut Tile, &mut Parameters);

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
    /// Where the machine lacks it.
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

    /// `outputs = g(inputs)` for the tile's rows; keeps the activations for [`Self::backward`].
    pub(crate) fn forward(&self, parameters: &Parameters, tile: &mut Tile) {
        // SAFETY: `new` checked the instruction set.
        unsafe { (self.forward)(parameters, tile) }
    }

    /// Adds the tile's parameter gradients to `gradients`, from its `output_gradients` and the
    /// activations of the last [`Self::forward`]. `transposed` holds the middle layers'
    /// transposes, see [`crate::flow::field::mlp::transpose_middle_layer`].
    pub(crate) fn backward(
        &self,
        parameters: &Parameters,
        transposed: &Parameters,
        tile: &mut Tile,
        gradients: &mut Parameters,
    ) {
        // SAFETY: `new` checked the instruction set.
        unsafe { (self.backward)(parameters, transposed, tile, gradients) }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn forward_avx512(parameters: &Parameters, tile: &mut Tile) {
    // SAFETY: avx512f is on.
    unsafe { forward::<F32x16, 12, 2>(parameters, tile) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
unsafe fn backward_avx512(p: &Parameters, t: &Parameters, tile: &mut Tile, g: &mut Parameters) {
    // SAFETY: avx512f is on.
    unsafe { backward::<F32x16, 12, 8, 2>(p, t, tile, g) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn forward_avx2(parameters: &Parameters, tile: &mut Tile) {
    // SAFETY: avx2 and fma are on.
    unsafe { forward::<F32x8, 6, 2>(parameters, tile) }
}
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn backward_avx2(p: &Parameters, t: &Parameters, tile: &mut Tile, g: &mut Parameters) {
    // SAFETY: avx2 and fma are on.
    unsafe { backward::<F32x8, 6, 2, 2>(p, t, tile, g) }
}
unsafe fn forward_portable(parameters: &Parameters, tile: &mut Tile) {
    // SAFETY: plain Rust needs no feature.
    unsafe { forward::<F32x4, 6, 2>(parameters, tile) }
}
unsafe fn backward_portable(p: &Parameters, t: &Parameters, tile: &mut Tile, g: &mut Parameters) {
    // SAFETY: plain Rust needs no feature.
    unsafe { backward::<F32x4, 6, 2, 2>(p, t, tile, g) }
}

/// A matrix in memory: where it starts and the floats from a row, and from a step of the summed
/// index, to the next.
#[derive(Clone, Copy)]
struct Strided {
    at: *const f32,
    row: usize,
    step: usize,
}

/// `acc[r][..] += sum_k a[r][k] * b[k][..]`: `ROWS` x `VECTORS` registers.
///
/// # Safety
/// `a` has `ROWS` rows and `depth` steps, `b` has `depth` rows of `VECTORS` registers, 32 apart
/// by `b_step`.
#[inline(always)]
unsafe fn multiply<L: Lanes, const ROWS: usize, const VECTORS: usize>(
    acc: &mut [[L; VECTORS]; ROWS],
    depth: usize,
    a: Strided,
    b: *const f32,
    b_step: usize,
) {
    // SAFETY: as the caller promises.
    unsafe {
        let mut a_at = a.at;
        let mut b_at = b;
        for _ in 0..depth {
            let mut row = [L::splat(0.0); VECTORS];
            for v in 0..VECTORS {
                row[v] = L::load(b_at.add(v * L::COUNT));
            }
            for r in 0..ROWS {
                let scale = L::splat(*a_at.add(r * a.row));
                for v in 0..VECTORS {
                    acc[r][v] = scale.mul_add(row[v], acc[r][v]);
                }
            }
            a_at = a_at.add(a.step);
            b_at = b_at.add(b_step);
        }
    }
}

/// Calls `body` with the first column of each register group of a 128-feature row, and the offset
/// of that column's panel.
#[inline(always)]
fn for_columns<L: Lanes, const VECTORS: usize>(mut body: impl FnMut(usize, usize)) {
    let group = VECTORS * L::COUNT;
    let mut column = 0;
    while column < WIDTH {
        body(column, column / PANEL * WIDTH * PANEL + column % PANEL);
        column += group;
    }
}

#[inline(always)]
unsafe fn forward<L: Lanes, const ROWS: usize, const VECTORS: usize>(
    parameters: &Parameters,
    tile: &mut Tile,
) {
    let rows = tile.padded_rows();
    let weights = parameters.as_slice().as_ptr();
    let activations = tile.activations.as_mut_slice().as_mut_ptr();
    // SAFETY: every offset stays within the layouts that `Parameters` and `Tile` define.
    unsafe {
        let at = first_layer();
        for column in (0..WIDTH).step_by(L::COUNT) {
            let w: [L; 3] =
                core::array::from_fn(|i| L::load(weights.add(at.weights + i * WIDTH + column)));
            let bias = L::load(weights.add(at.bias + column));
            for row in 0..rows {
                let x = tile.inputs[row];
                let sum = L::splat(x[0]).mul_add(w[0], bias);
                let sum = L::splat(x[1]).mul_add(w[1], sum);
                let sum = L::splat(x[2]).mul_add(w[2], sum);
                sum.relu().store(activations.add(row * STRIDE + column));
            }
        }
        for layer in 0..MIDDLE_LAYERS {
            let at = middle_layer(layer);
            let from = activations.add(layer * TILE * STRIDE);
            let to = activations.add((layer + 1) * TILE * STRIDE);
            for_columns::<L, VECTORS>(|column, panel| {
                for row in (0..rows).step_by(ROWS) {
                    let bias: [L; VECTORS] = core::array::from_fn(|v| {
                        L::load(weights.add(at.bias + column + v * L::COUNT))
                    });
                    let mut acc = [bias; ROWS];
                    let a = Strided {
                        at: from.add(row * STRIDE),
                        row: STRIDE,
                        step: 1,
                    };
                    multiply(&mut acc, WIDTH, a, weights.add(at.weights + panel), PANEL);
                    for r in 0..ROWS {
                        for v in 0..VECTORS {
                            let out = to.add((row + r) * STRIDE + column + v * L::COUNT);
                            acc[r][v].relu().store(out);
                        }
                    }
                }
            });
        }
        let at = last_layer();
        let from = activations.add(MIDDLE_LAYERS * TILE * STRIDE);
        for row in 0..tile.rows {
            for output in 0..3 {
                let mut acc = L::splat(0.0);
                for column in (0..WIDTH).step_by(L::COUNT) {
                    let h = L::load(from.add(row * STRIDE + column));
                    let w = L::load(weights.add(at.weights + output * WIDTH + column));
                    acc = h.mul_add(w, acc);
                }
                tile.outputs[row][output] = acc.sum() + *weights.add(at.bias + output);
            }
        }
    }
}

#[inline(always)]
unsafe fn backward<L: Lanes, const ROWS: usize, const TAIL: usize, const VECTORS: usize>(
    parameters: &Parameters,
    transposed: &Parameters,
    tile: &mut Tile,
    gradients: &mut Parameters,
) {
    let rows = tile.padded_rows();
    let weights = parameters.as_slice().as_ptr();
    let transposes = transposed.as_slice().as_ptr();
    let grads = gradients.as_mut_slice().as_mut_ptr();
    let activations = tile.activations.as_slice().as_ptr();
    let [first, second] = &mut tile.deltas;
    let mut delta = first.as_mut_slice().as_mut_ptr();
    let mut next_delta = second.as_mut_slice().as_mut_ptr();
    // SAFETY: every offset stays within the layouts that `Parameters` and `Tile` define.
    unsafe {
        let at = last_layer();
        let h = activations.add(MIDDLE_LAYERS * TILE * STRIDE);
        for column in (0..WIDTH).step_by(L::COUNT) {
            let w: [L; 3] =
                core::array::from_fn(|o| L::load(weights.add(at.weights + o * WIDTH + column)));
            let mut dw: [L; 3] =
                core::array::from_fn(|o| L::load(grads.add(at.weights + o * WIDTH + column)));
            for row in 0..rows {
                let g = tile.output_gradients[row].map(|g| L::splat(g));
                let h = L::load(h.add(row * STRIDE + column));
                for o in 0..3 {
                    dw[o] = g[o].mul_add(h, dw[o]);
                }
                let d = g[0].mul_add(w[0], g[1].mul_add(w[1], g[2].mul_add(w[2], L::splat(0.0))));
                d.where_positive(h).store(delta.add(row * STRIDE + column));
            }
            for o in 0..3 {
                dw[o].store(grads.add(at.weights + o * WIDTH + column));
            }
        }
        for gradient in &tile.output_gradients[..tile.rows] {
            for o in 0..3 {
                *grads.add(at.bias + o) += gradient[o];
            }
        }

        for layer in (0..MIDDLE_LAYERS).rev() {
            let at = middle_layer(layer);
            let h = activations.add(layer * TILE * STRIDE);
            add_column_sums::<L>(delta, rows, grads.add(at.bias));
            for_columns::<L, VECTORS>(|column, panel| {
                let b = delta.cast_const().add(column);
                let to = grads.add(at.weights + panel);
                let mut k = 0;
                while k + ROWS <= WIDTH {
                    weight_gradient::<L, ROWS, VECTORS>(h.add(k), rows, b, to.add(k * PANEL));
                    k += ROWS;
                }
                while k < WIDTH {
                    weight_gradient::<L, TAIL, VECTORS>(h.add(k), rows, b, to.add(k * PANEL));
                    k += TAIL;
                }
            });
            for_columns::<L, VECTORS>(|column, panel| {
                for row in (0..rows).step_by(ROWS) {
                    let mut acc = [[L::splat(0.0); VECTORS]; ROWS];
                    let a = Strided {
                        at: delta.add(row * STRIDE),
                        row: STRIDE,
                        step: 1,
                    };
                    multiply(
                        &mut acc,
                        WIDTH,
                        a,
                        transposes.add(at.weights + panel),
                        PANEL,
                    );
                    for r in 0..ROWS {
                        for v in 0..VECTORS {
                            let place = (row + r) * STRIDE + column + v * L::COUNT;
                            let gate = L::load(h.add(place));
                            acc[r][v].where_positive(gate).store(next_delta.add(place));
                        }
                    }
                }
            });
            core::mem::swap(&mut delta, &mut next_delta);
        }

        let at = first_layer();
        add_column_sums::<L>(delta, rows, grads.add(at.bias));
        for column in (0..WIDTH).step_by(L::COUNT) {
            let mut dw: [L; 3] =
                core::array::from_fn(|i| L::load(grads.add(at.weights + i * WIDTH + column)));
            for row in 0..rows {
                let d = L::load(delta.add(row * STRIDE + column));
                for i in 0..3 {
                    dw[i] = L::splat(tile.inputs[row][i]).mul_add(d, dw[i]);
                }
            }
            for i in 0..3 {
                dw[i].store(grads.add(at.weights + i * WIDTH + column));
            }
        }
    }
}

/// `to[0..128] += sum of rows`.
#[inline(always)]
unsafe fn add_column_sums<L: Lanes>(from: *const f32, rows: usize, to: *mut f32) {
    for column in (0..WIDTH).step_by(L::COUNT) {
        // SAFETY: `from` holds `rows` rows and `to` holds 128 floats.
        unsafe {
            let mut sum = L::load(to.add(column));
            for row in 0..rows {
                sum = sum.add(L::load(from.add(row * STRIDE + column)));
            }
            sum.store(to.add(column));
        }
    }
}

/// Adds `sum_p h[p][k] * d[p][n]` to `ROWS` inputs k by one register group of outputs n.
#[inline(always)]
unsafe fn weight_gradient<L: Lanes, const ROWS: usize, const VECTORS: usize>(
    h: *const f32,
    points: usize,
    d: *const f32,
    to: *mut f32,
) {
    // SAFETY: `h` and `d` hold `points` rows, `to` holds `ROWS` rows of a panel.
    unsafe {
        let mut acc = [[L::splat(0.0); VECTORS]; ROWS];
        for r in 0..ROWS {
            for v in 0..VECTORS {
                acc[r][v] = L::load(to.add(r * PANEL + v * L::COUNT));
            }
        }
        multiply(
            &mut acc,
            points,
            Strided {
                at: h,
                row: 1,
                step: STRIDE,
            },
            d,
            STRIDE,
        );
        for r in 0..ROWS {
            for v in 0..VECTORS {
                acc[r][v].store(to.add(r * PANEL + v * L::COUNT));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::field::mlp::transpose_middle_layers;
    use crate::flow::random::Random;
    use crate::flow::reference::ReferenceNetwork;

    /// Single precision over sums of 128 and of 96 terms, eight layers deep.
    const TOLERANCE: f64 = 2e-5;
    /// Row counts around a register tile, a tile, and an empty one.
    const ROWS: [usize; 8] = [0, 1, 5, 11, 12, 13, 95, 96];

    fn network() -> Parameters {
        let mut random = Random::new(7);
        let mut parameters = Parameters::xavier(&mut random);
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

    /// The largest difference, relative to the largest reference value.
    fn worst(values: &[f64], reference: &[f64]) -> f64 {
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
        let reference = ReferenceNetwork::read(&parameters);
        for isa in Isa::available() {
            let mut tile = Tile::new();
            for rows in ROWS {
                let inputs = points(rows, 11);
                tile.load(inputs.iter().copied());
                Kernels::new(isa).forward(&parameters, &mut tile);
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
        let reference = ReferenceNetwork::read(&parameters);
        let mut transposed = Parameters::zeros();
        transpose_middle_layers(&parameters, &mut transposed);
        for isa in Isa::available() {
            let kernels = Kernels::new(isa);
            let mut tile = Tile::new();
            for rows in ROWS {
                let (inputs, pulls) = (points(rows, 12), points(rows, 13));
                let mut gradients = Parameters::zeros();
                let mut expected = ReferenceNetwork::read(&gradients);
                tile.load(inputs.iter().copied());
                kernels.forward(&parameters, &mut tile);
                tile.output_gradients[..rows].copy_from_slice(&pulls);
                kernels.backward(&parameters, &transposed, &mut tile, &mut gradients);
                for (input, pull) in inputs.iter().zip(&pulls) {
                    let (input, pull) = (input.map(f64::from), pull.map(f64::from));
                    reference.backward(input, pull, &mut expected);
                }
                let error = worst(&ReferenceNetwork::read(&gradients).flat(), &expected.flat());
                assert!(error < TOLERANCE, "{isa:?}, {rows} rows: {error}");
            }
        }
    }

    #[test]
    fn the_reference_gradient_is_the_finite_difference_of_the_reference_network() {
        // Central differences in double precision; a step of 1e-6 crosses no kink of this input.
        const STEP: f64 = 1e-6;
        let mut reference = ReferenceNetwork::read(&network());
        let (input, pull) = ([0.4, -1.3, 0.8], [0.7, -0.2, 0.5]);
        let mut gradients = ReferenceNetwork::read(&Parameters::zeros());
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
