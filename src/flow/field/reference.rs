//! Reference implementation for the tests: the paper's formulas in double-precision loops.
//!
//! The kernels are tested against it. It shares with them only the layout of [`Parameters`], their
//! initialization, and the distance transform, which has its own tests.

use super::mlp::{
    self, MIDDLE_LAYERS, PANEL, WIDTH, first_layer, last_layer, middle_layer, panel_index,
};
use crate::flow::data::{Point, Random};
use crate::flow::distance::DistanceTransform;

/// The network as dense matrices: `weights[layer][output][input]`, `biases[layer][output]`.
#[derive(Clone)]
pub(crate) struct ReferenceNetwork {
    pub(crate) weights: Vec<Vec<Vec<f64>>>,
    pub(crate) biases: Vec<Vec<f64>>,
}

impl ReferenceNetwork {
    /// Reads parameters or gradients from their memory layout, one by one.
    pub(crate) fn read(floats: &[f32]) -> Self {
        assert_eq!(PANEL, 32, "the layout below is written for panels of 32");
        let at = |index: usize| f64::from(floats[index]);
        let mut weights = Vec::new();
        let mut biases = Vec::new();
        let first = first_layer();
        weights.push(matrix(WIDTH, 3, |o, i| at(first.weights + i * WIDTH + o)));
        biases.push((0..WIDTH).map(|o| at(first.bias + o)).collect());
        for layer in 0..MIDDLE_LAYERS {
            let index = middle_layer(layer);
            weights.push(matrix(WIDTH, WIDTH, |o, i| {
                at(index.weights + panel_index(i, o))
            }));
            biases.push((0..WIDTH).map(|o| at(index.bias + o)).collect());
        }
        let last = last_layer();
        weights.push(matrix(3, WIDTH, |o, i| at(last.weights + o * WIDTH + i)));
        biases.push((0..3).map(|o| at(last.bias + o)).collect());
        Self { weights, biases }
    }

    /// Activations of every layer, the input first and the output last.
    fn activations(&self, input: [f64; 3]) -> Vec<Vec<f64>> {
        let mut layers = vec![input.to_vec()];
        for (number, (weights, biases)) in self.weights.iter().zip(&self.biases).enumerate() {
            let from = &layers[number];
            let linear = weights
                .iter()
                .zip(biases)
                .map(|(row, bias)| bias + row.iter().zip(from).map(|(w, h)| w * h).sum::<f64>());
            let last = number + 1 == self.weights.len();
            layers.push(linear.map(|x| if last { x } else { x.max(0.0) }).collect());
        }
        layers
    }

    /// `g(input)`.
    pub(crate) fn forward(&self, input: [f64; 3]) -> [f64; 3] {
        let output = self.activations(input).pop().expect("a network has layers");
        [output[0], output[1], output[2]]
    }

    /// Adds to `gradients` the derivative of `output_gradient . g(input)` with respect to every
    /// parameter. Returns that with respect to the input.
    pub(crate) fn backward(
        &self,
        input: [f64; 3],
        output_gradient: [f64; 3],
        gradients: &mut Self,
    ) -> [f64; 3] {
        let layers = self.activations(input);
        let mut delta = output_gradient.to_vec();
        for number in (0..self.weights.len()).rev() {
            for (output, d) in delta.iter().enumerate() {
                gradients.biases[number][output] += d;
                for (i, h) in layers[number].iter().enumerate() {
                    gradients.weights[number][output][i] += d * h;
                }
            }
            delta = (0..layers[number].len())
                .map(|i| {
                    let back: f64 = delta
                        .iter()
                        .zip(&self.weights[number])
                        .map(|(d, row)| d * row[i])
                        .sum();
                    if number == 0 || layers[number][i] > 0.0 {
                        back
                    } else {
                        0.0
                    }
                })
                .collect();
        }
        [delta[0], delta[1], delta[2]]
    }

    /// Adam's step (Kingma and Ba 2015) number `iteration`, from 1.
    pub(crate) fn adam_step(
        &mut self,
        gradients: &Self,
        moments: &mut [Vec<f64>; 2],
        iteration: i32,
        learning_rate: f64,
    ) {
        let [means, squares] = moments;
        let weights = self.weights.iter_mut().flatten().flatten();
        let values = weights.chain(self.biases.iter_mut().flatten());
        for (i, (value, g)) in values.zip(gradients.flat()).enumerate() {
            means[i] = 0.9 * means[i] + 0.1 * g;
            squares[i] = 0.999 * squares[i] + 0.001 * g * g;
            let mean = means[i] / (1.0 - 0.9f64.powi(iteration));
            let square = squares[i] / (1.0 - 0.999f64.powi(iteration));
            *value -= learning_rate * mean / (square.sqrt() + 1e-8);
        }
    }

    /// All weights, then all biases, in one list.
    pub(crate) fn flat(&self) -> Vec<f64> {
        let weights = self.weights.iter().flatten().flatten();
        weights
            .chain(self.biases.iter().flatten())
            .copied()
            .collect()
    }
}

/// A loss of a deformed cloud, and its derivative with respect to each deformed point.
pub(crate) type ReferenceLoss<'a> = dyn Fn(&[[f64; 3]]) -> (f64, Vec<[f64; 3]>) + 'a;

/// The mean distance of a deformed cloud in a distance transform, metres.
pub(crate) fn mean_distance(
    distance: &DistanceTransform,
) -> impl Fn(&[[f64; 3]]) -> (f64, Vec<[f64; 3]>) {
    |deformed| {
        let count = deformed.len() as f64;
        let samples = deformed
            .iter()
            .map(|point| distance.sample(point.map(|x| x as f32)));
        let samples: Vec<_> = samples.collect();
        let mean = samples.iter().map(|s| f64::from(s.distance) / count).sum();
        let gradients = samples
            .iter()
            .map(|s| s.gradient.map(|g| f64::from(g) / count));
        (mean, gradients.collect())
    }
}

/// The losses of a fit of the network to `loss` in its first iterations over `source`, initialized
/// from `seed`, with Adam at a constant `rate`.
pub(crate) fn first_losses(
    source: &[Point],
    loss: &ReferenceLoss<'_>,
    seed: u64,
    rate: f64,
    iterations: i32,
) -> Vec<f64> {
    let mut network = ReferenceNetwork::read(mlp::xavier(&mut Random::stream(seed, 0)).as_slice());
    let zeros = vec![0.0; network.flat().len()];
    let mut moments = [zeros.clone(), zeros];
    let mut losses = Vec::new();
    let inputs: Vec<[f64; 3]> = source.iter().map(|point| point.map(f64::from)).collect();
    for iteration in 1..=iterations {
        let mut gradients = ReferenceNetwork::read(mlp::zeros().as_slice());
        let deformed = |&input: &[f64; 3]| {
            let flow = network.forward(input);
            [0, 1, 2].map(|a| input[a] + flow[a])
        };
        let (value, pulls) = loss(&inputs.iter().map(deformed).collect::<Vec<_>>());
        for (&input, pull) in inputs.iter().zip(pulls) {
            network.backward(input, pull, &mut gradients);
        }
        network.adam_step(&gradients, &mut moments, iteration, rate);
        losses.push(value);
    }
    losses
}

/// NSFP's loss of two networks with the cycle, in plain loops: the truncated Chamfer distance of the
/// deformed source to `target`, and that of the points led back to `source`. Adds its derivatives
/// with respect to the parameters of both networks to `gradients`.
pub(crate) fn cycle_loss(
    [forward, backward]: [&ReferenceNetwork; 2],
    [source, target]: [&[Point]; 2],
    truncation: f64,
    gradients: &mut [ReferenceNetwork; 2],
) -> f64 {
    let minus = |a: [f64; 3], b: [f64; 3]| [0, 1, 2].map(|axis| a[axis] - b[axis]);
    let inputs: Vec<[f64; 3]> = source.iter().map(|point| point.map(f64::from)).collect();
    let mut deformed = Vec::new();
    let mut led_back = Vec::new();
    for &input in &inputs {
        let flow = forward.forward(input);
        let there = [0, 1, 2].map(|axis| input[axis] + flow[axis]);
        deformed.push(there);
        led_back.push(minus(there, backward.forward(there)));
    }
    let (to_target, pulls) = chamfer_distance(&deformed, target, truncation);
    let (to_source, pulls_back) = chamfer_distance(&led_back, source, truncation);
    for (row, &input) in inputs.iter().enumerate() {
        let back = pulls_back[row].map(|pull| -pull);
        let through = backward.backward(deformed[row], back, &mut gradients[1]);
        let pull = [0, 1, 2].map(|axis| pulls[row][axis] + pulls_back[row][axis] + through[axis]);
        forward.backward(input, pull, &mut gradients[0]);
    }
    to_target + to_source
}

/// The losses of a fit of two networks in a cycle in its first iterations, as [`first_losses`].
pub(crate) fn first_cycle_losses(
    clouds: [&[Point]; 2],
    truncation: f64,
    seed: u64,
    rate: f64,
    iterations: i32,
) -> Vec<f64> {
    let network = mlp::xavier(&mut Random::stream(seed, 0));
    let network = ReferenceNetwork::read(network.as_slice());
    let zeros = ReferenceNetwork::read(mlp::zeros().as_slice());
    let mut networks = [network.clone(), network];
    let moments = vec![0.0; zeros.flat().len()];
    let mut moments = [(); 2].map(|()| [moments.clone(), moments.clone()]);
    let mut losses = Vec::new();
    for iteration in 1..=iterations {
        let mut gradients = [zeros.clone(), zeros.clone()];
        let [forward, backward] = &networks;
        let both = [forward, backward];
        losses.push(cycle_loss(both, clouds, truncation, &mut gradients));
        for ((network, gradients), moments) in networks.iter_mut().zip(&gradients).zip(&mut moments)
        {
            network.adam_step(gradients, moments, iteration, rate);
        }
    }
    losses
}

fn matrix(rows: usize, columns: usize, entry: impl Fn(usize, usize) -> f64) -> Vec<Vec<f64>> {
    (0..rows)
        .map(|r| (0..columns).map(|c| entry(r, c)).collect())
        .collect()
}

/// The truncated Chamfer distance between `deformed` and `target`, square metres, and its derivative
/// with respect to each deformed point.
pub(crate) fn chamfer_distance(
    deformed: &[[f64; 3]],
    target: &[Point],
    truncation: f64,
) -> (f64, Vec<[f64; 3]>) {
    let target: Vec<[f64; 3]> = target.iter().map(|t| t.map(f64::from)).collect();
    let squared = |a: [f64; 3], b: [f64; 3]| -> f64 { (0..3).map(|x| (a[x] - b[x]).powi(2)).sum() };
    let nearest = |at: [f64; 3], sites: &[[f64; 3]]| {
        let by_distance =
            |&a: &usize, &b: &usize| squared(at, sites[a]).total_cmp(&squared(at, sites[b]));
        let index = (0..sites.len()).min_by(by_distance).expect("a site");
        (index, squared(at, sites[index]))
    };
    let mut gradients = vec![[0.0; 3]; deformed.len()];
    let mut sum = 0.0;
    let mut add = |row: usize, site: usize, square: f64, count: usize| {
        if square < truncation * truncation {
            sum += square / count as f64;
            for axis in 0..3 {
                let off = deformed[row][axis] - target[site][axis];
                gradients[row][axis] += 2.0 * off / count as f64;
            }
        }
    };
    for (row, &at) in deformed.iter().enumerate() {
        let (site, square) = nearest(at, &target);
        add(row, site, square, deformed.len());
    }
    for (site, &at) in target.iter().enumerate() {
        let (row, square) = nearest(at, deformed);
        add(row, site, square, target.len());
    }
    (sum, gradients)
}

/// Euclidean distance from `at` to the nearest of `sites`.
pub(crate) fn nearest_distance(at: [f64; 3], sites: &[[f64; 3]]) -> f64 {
    let mut nearest = f64::INFINITY;
    for site in sites {
        let square: f64 = (0..3).map(|a| (at[a] - site[a]).powi(2)).sum();
        nearest = nearest.min(square.sqrt());
    }
    nearest
}

/// Length of the shortest path of straight and diagonal steps from `at` to one of `sites`.
pub(crate) fn nearest_chamfer(at: [f64; 3], sites: &[[f64; 3]]) -> f64 {
    let mut nearest = f64::INFINITY;
    for site in sites {
        let mut gaps = [0, 1, 2].map(|a| (at[a] - site[a]).abs());
        gaps.sort_by(f64::total_cmp);
        let [c, b, a] = gaps;
        let root = f64::sqrt;
        nearest = nearest.min(a + (root(2.0) - 1.0) * b + (root(3.0) - root(2.0)) * c);
    }
    nearest
}

/// Trilinear value and gradient at `at`, in cells, of values given at integer positions.
pub(crate) fn trilinear(at: [f64; 3], value: impl Fn([u32; 3]) -> f64) -> (f64, [f64; 3]) {
    let (mut sum, mut gradient) = (0.0, [0.0; 3]);
    let fraction = at.map(|c| c - c.floor());
    for corner in 0..8u32 {
        let bits = [corner >> 2, corner >> 1 & 1, corner & 1];
        let vertex = [0, 1, 2].map(|a| at[a].floor() as u32 + bits[a]);
        let weight = [0, 1, 2].map(|a| {
            if bits[a] == 1 {
                fraction[a]
            } else {
                1.0 - fraction[a]
            }
        });
        sum += weight.iter().product::<f64>() * value(vertex);
        for axis in 0..3 {
            let others: f64 = (0..3).filter(|&a| a != axis).map(|a| weight[a]).product();
            gradient[axis] += (f64::from(bits[axis]) * 2.0 - 1.0) * others * value(vertex);
        }
    }
    (sum, gradient)
}
