//! The coordinate network of FNSF, Section 3: a ReLU MLP with layers 3 -> 128, seven times 128 ->
//! 128 and 128 -> 3; `g(p; theta)` in the paper.
//!
//! This file holds its shape, its Xavier initialization, and the memory layout that the kernels of
//! every backend share.

use super::parameters::Parameters;
use crate::flow::data::{Point, Random};
use crate::flow::options::{InputNormalization, Start};

/// Number of features of every hidden layer.
pub const WIDTH: usize = 128;
/// Number of middle layers. Each maps 128 features to 128 features.
pub const MIDDLE_LAYERS: usize = 7;
/// Number of hidden layers: the first (3 -> 128) and the middle ones.
pub const HIDDEN_LAYERS: usize = MIDDLE_LAYERS + 1;
/// Number of parameters of the network, weights and biases of all layers: 116,483.
pub const PARAMETERS: usize = 4 * WIDTH + MIDDLE_LAYERS * (WIDTH * WIDTH + WIDTH) + 3 * WIDTH + 3;

/// Output features per panel of a middle layer's weights. A kernel reads a panel as one stream.
pub(crate) const PANEL: usize = 32;

const FIRST: usize = 0;
const MIDDLE: usize = 4 * WIDTH;
const MIDDLE_STRIDE: usize = WIDTH * WIDTH + WIDTH;
const LAST: usize = MIDDLE + MIDDLE_LAYERS * MIDDLE_STRIDE;
/// Floats of the network in memory: the parameters, padded to whole cache lines.
pub(crate) const LAID_OUT: usize = (LAST + 3 * WIDTH + 3).next_multiple_of(16);

/// The offsets of a layer's weights and biases, in floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LayerAt {
    pub(crate) weights: usize,
    pub(crate) bias: usize,
}

/// The first layer, 3 -> 128.
pub(crate) const fn first_layer() -> LayerAt {
    LayerAt {
        weights: FIRST,
        bias: FIRST + 3 * WIDTH,
    }
}

/// Middle layer `index` of 0..7, 128 -> 128.
pub(crate) const fn middle_layer(index: usize) -> LayerAt {
    let weights = MIDDLE + index * MIDDLE_STRIDE;
    LayerAt {
        weights,
        bias: weights + WIDTH * WIDTH,
    }
}

/// The last layer, 128 -> 3.
pub(crate) const fn last_layer() -> LayerAt {
    LayerAt {
        weights: LAST,
        bias: LAST + 3 * WIDTH,
    }
}

/// The index of weight (`input`, `output`) within a middle layer's panels.
pub(crate) const fn panel_index(input: usize, output: usize) -> usize {
    (output / PANEL * WIDTH + input) * PANEL + output % PANEL
}

/// Zeros in the layout of the network: first layer `W[3][128]`, bias; each middle layer `W` in
/// panels of 32 output features (`[panel][input][32]`), bias; last layer `W[3][128]`
/// (output-major), bias; padding.
pub(crate) fn zeros() -> Parameters {
    Parameters::zeros(LAID_OUT)
}

/// Xavier-uniform weights, `U(-a, a)` with `a = sqrt(6 / (inputs + outputs))`, and zero biases. The
/// weights are drawn layer by layer in output-major order, as a linear layer stores them.
pub(crate) fn xavier(random: &mut Random) -> Parameters {
    let mut parameters = zeros();
    let floats = parameters.as_mut_slice();
    let mut layer = |inputs: usize, outputs: usize, index: &dyn Fn(usize, usize) -> usize| {
        let bound = (6.0 / (inputs + outputs) as f64).sqrt();
        for output in 0..outputs {
            for input in 0..inputs {
                floats[index(input, output)] = random.uniform(-bound, bound) as f32;
            }
        }
    };
    layer(3, WIDTH, &|i, o| FIRST + i * WIDTH + o);
    for number in 0..MIDDLE_LAYERS {
        let at = middle_layer(number).weights;
        layer(WIDTH, WIDTH, &|i, o| at + panel_index(i, o));
    }
    layer(WIDTH, 3, &|i, o| LAST + o * WIDTH + i);
    parameters
}

/// The parameters before the first iteration: [`xavier`], for [`Start::ZeroFlow`] with a last layer
/// of zeros.
pub(crate) fn initial(start: Start, random: &mut Random) -> Parameters {
    let mut parameters = xavier(random);
    if start == Start::ZeroFlow {
        parameters.as_mut_slice()[LAST..].fill(0.0);
    }
    parameters
}

/// Largest coordinate of a cloud's mean, along any axis, for which raw coordinates are used,
/// metres. In a sensor's frame the mean is tens of metres from the origin. At a kilometre, the
/// network's initial flow is several metres long, and the fit cannot undo it with any step size.
const FAR_MEAN_M: f32 = 200.0;

/// The normalization of coordinates to network inputs: `(p - center) * scale`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Conditioning {
    pub(crate) center: Point,
    pub(crate) scale: f32,
}

impl Conditioning {
    pub(crate) fn new(points: &[Point], inputs: InputNormalization) -> Self {
        let mean = |axis: usize| {
            let sum: f64 = points.iter().map(|point| f64::from(point[axis])).sum();
            (sum / points.len().max(1) as f64) as f32
        };
        let mean = [mean(0), mean(1), mean(2)];
        match inputs {
            InputNormalization::Raw => {
                let is_far = mean.iter().any(|axis| axis.abs() > FAR_MEAN_M);
                Self {
                    center: if is_far { mean } else { [0.0; 3] },
                    scale: 1.0,
                }
            }
            InputNormalization::Centered { scale_m } => Self {
                center: mean,
                scale: 1.0 / scale_m,
            },
        }
    }

    #[inline]
    pub(crate) fn apply(&self, point: Point) -> Point {
        core::array::from_fn(|a| (point[a] - self.center[a]) * self.scale)
    }
}

/// Writes the transposes of the middle layers of one network, in the same panels, so that the
/// backward kernels also read one stream.
pub(crate) fn transpose_middle_layers(from: &[f32], to: &mut [f32]) {
    for layer in 0..MIDDLE_LAYERS {
        let at = middle_layer(layer);
        let weights = at.weights..at.bias;
        transpose(&from[weights.clone()], &mut to[weights]);
    }
}

/// Entry (`output`, `input`) of `to` becomes entry (`input`, `output`) of `from`.
fn transpose(from: &[f32], to: &mut [f32]) {
    for output_panel in 0..WIDTH / PANEL {
        for input_panel in 0..WIDTH / PANEL {
            for input in input_panel * PANEL..(input_panel + 1) * PANEL {
                let row = panel_index(input, output_panel * PANEL);
                for lane in 0..PANEL {
                    let output = output_panel * PANEL + lane;
                    to[panel_index(output, input)] = from[row + lane];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_network_has_the_published_number_of_parameters() {
        assert_eq!(PARAMETERS, 116_483);
        assert_eq!(LAST + 3 * WIDTH + 3, PARAMETERS);
    }

    #[test]
    fn xavier_weights_fill_their_interval_and_biases_are_zero() {
        let parameters = xavier(&mut Random::new(3));
        let floats = parameters.as_slice();
        let at = middle_layer(4);
        let bound = (6.0f32 / 256.0).sqrt();
        let weights = &floats[at.weights..at.bias];
        let largest = weights.iter().fold(0.0f32, |a, w| a.max(w.abs()));
        assert!(
            largest <= bound && largest > 0.99 * bound,
            "{largest} of {bound}"
        );
        assert!(floats[at.bias..at.bias + WIDTH].iter().all(|&b| b == 0.0));
    }

    #[test]
    fn transposing_twice_gives_the_layer_back() {
        let parameters = xavier(&mut Random::new(1));
        let at = middle_layer(0);
        let layer = &parameters.as_slice()[at.weights..at.bias];
        let mut once = vec![0.0; layer.len()];
        let mut twice = vec![0.0; layer.len()];
        transpose(layer, &mut once);
        transpose(&once, &mut twice);
        assert_eq!(once[panel_index(5, 77)], layer[panel_index(77, 5)]);
        assert_eq!(twice, layer);
    }
}
