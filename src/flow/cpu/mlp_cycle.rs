//! Two coordinate networks in a cycle, as in NSFP: the flow, and the flow back from where it leads.

use std::sync::Arc;

use super::mlp::{HELD, Pass, add_to_the_first, sum};
use super::model::Model;
use super::tile::{TILE, Tile, WorkingSets};
use crate::flow::data::Point;
use crate::flow::field::{FittedField, LAID_OUT, Parameters, transpose_middle_layers};

/// The parameters of the forward network, then those of the backward network.
const BOTH: usize = 2 * LAID_OUT;

/// The working set of one thread: a tile of each network, and their outputs.
pub(super) struct Tiles {
    forward: Tile,
    backward: Tile,
    outputs: [[Point; 2]; TILE],
}

/// The forward network `g` and the backward network `h`: the outputs are `f = g(p)` and
/// `b = h(p + f)`. The parameters of `h` follow those of `g`. The fitted field is `g`.
pub(super) struct MlpCycle {
    pass: Pass,
    threads: Arc<rayon::ThreadPool>,
    /// The transposed weights of the middle layers of both networks.
    transposed: Parameters,
}

impl MlpCycle {
    pub(super) fn new(pass: Pass, threads: Arc<rayon::ThreadPool>) -> Self {
        Self {
            pass,
            threads,
            transposed: Parameters::zeros(BOTH),
        }
    }

    /// The parameters of two networks. Both are equal to `initial`.
    pub(super) fn twice(initial: &Parameters) -> Parameters {
        let mut both = Parameters::zeros(BOTH);
        for half in both.as_mut_slice().chunks_exact_mut(LAID_OUT) {
            half.copy_from_slice(initial.as_slice());
        }
        both
    }
}

impl Model for MlpCycle {
    type Output = [Point; 2];
    type WorkingSet = Tiles;
    type ChunkGradients = Parameters;
    const HELD: usize = HELD;

    fn working_set(&self) -> Tiles {
        Tiles {
            forward: Tile::new(),
            backward: Tile::new(),
            outputs: [[[0.0; 3]; 2]; TILE],
        }
    }

    fn update(&mut self, parameters: &Parameters) {
        let from = parameters.as_slice().chunks_exact(LAID_OUT);
        let to = self.transposed.as_mut_slice().chunks_exact_mut(LAID_OUT);
        from.zip(to)
            .for_each(|(from, to)| transpose_middle_layers(from, to));
    }

    fn forward<'a>(
        &self,
        parameters: &Parameters,
        points: &[Point],
        _: usize,
        tiles: &'a mut Tiles,
    ) -> &'a [[Point; 2]] {
        let (forward, backward) = parameters.as_slice().split_at(LAID_OUT);
        let flows = self
            .pass
            .forward(forward, points.iter().copied(), &mut tiles.forward);
        let deformed = points.iter().zip(flows);
        let deformed = deformed.map(|(point, flow)| core::array::from_fn(|a| point[a] + flow[a]));
        let backs = self.pass.forward(backward, deformed, &mut tiles.backward);
        for (output, (&flow, &back)) in tiles.outputs.iter_mut().zip(flows.iter().zip(backs)) {
            *output = [flow, back];
        }
        &tiles.outputs[..points.len()]
    }

    fn chunk_gradients(&self) -> Parameters {
        Parameters::zeros(BOTH)
    }

    fn clear(&self, chunk: &mut Parameters) {
        chunk.as_mut_slice().fill(0.0);
    }

    fn backward(
        &self,
        parameters: &Parameters,
        output_gradients: &[[Point; 2]],
        tiles: &mut Tiles,
        chunk: &mut Parameters,
    ) {
        let (forward, backward) = parameters.as_slice().split_at(LAID_OUT);
        let transposed = self.transposed.as_slice().split_at(LAID_OUT);
        let chunk = chunk.as_mut_slice().split_at_mut(LAID_OUT);
        let pass = &self.pass;
        for (to, gradient) in tiles
            .backward
            .output_gradients
            .iter_mut()
            .zip(output_gradients)
        {
            *to = gradient[1];
        }
        pass.backward(backward, transposed.1, &mut tiles.backward, chunk.1);
        // The backward network's input is the deformed point, normalized.
        let inputs = tiles.backward.input_gradients(backward);
        let scale = pass.conditioning.scale;
        let rows = tiles.forward.output_gradients.iter_mut().zip(inputs);
        for ((to, input), gradient) in rows.zip(output_gradients) {
            *to = core::array::from_fn(|a| gradient[0][a] + scale * input[a]);
        }
        pass.backward(forward, transposed.0, &mut tiles.forward, chunk.0);
    }

    fn add_to_the_first(&self, chunks: &mut [Parameters]) {
        add_to_the_first(&self.threads, chunks);
    }

    fn gradient(&mut self, chunks: &[Parameters], gradients: &mut Parameters) {
        sum(&self.threads, chunks, gradients);
    }

    fn fitted(&self, parameters: &Parameters) -> FittedField {
        self.pass.fitted(&parameters.as_slice()[..LAID_OUT])
    }

    fn evaluate(
        &self,
        parameters: &Parameters,
        points: &[Point],
        working_sets: &WorkingSets<Tiles>,
    ) -> Vec<Point> {
        let (pass, forward) = (&self.pass, &parameters.as_slice()[..LAID_OUT]);
        pass.evaluate(forward, points, &self.threads, working_sets, |tiles| {
            &mut tiles.forward
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::cpu::kernels::Kernels;
    use crate::flow::data::Random;
    use crate::flow::field::{Conditioning, ReferenceNetwork, cycle_loss, mlp};
    use crate::flow::simd::Isa;

    fn cloud(count: usize, seed: u64) -> Vec<Point> {
        let mut random = Random::new(seed);
        let mut point = || core::array::from_fn(|_| random.uniform(-3.0, 3.0) as f32);
        (0..count).map(|_| point()).collect()
    }

    /// The parameters of two different networks.
    fn parameters() -> Parameters {
        let mut parameters = Parameters::zeros(BOTH);
        for (seed, half) in parameters
            .as_mut_slice()
            .chunks_exact_mut(LAID_OUT)
            .enumerate()
        {
            half.copy_from_slice(mlp::xavier(&mut Random::new(seed as u64)).as_slice());
        }
        parameters
    }

    fn halves(parameters: &Parameters) -> [ReferenceNetwork; 2] {
        let (forward, backward) = parameters.as_slice().split_at(LAID_OUT);
        [forward, backward].map(ReferenceNetwork::read)
    }

    #[test]
    fn both_gradients_are_those_in_double_precision_at_awkward_row_counts() {
        // Rounding of single precision through sixteen layers.
        const TOLERANCE: f64 = 1e-4;
        let parameters = parameters();
        let [forward, backward] = halves(&parameters);
        let conditioning = Conditioning {
            center: [0.5, -1.0, 0.25],
            scale: 0.5,
        };
        let threads = rayon::ThreadPoolBuilder::new().num_threads(1).build();
        let threads = Arc::new(threads.expect("a thread"));
        for isa in Isa::available() {
            let pass = Pass {
                kernels: Kernels::new(isa),
                conditioning,
                flat: false,
            };
            let mut model = MlpCycle::new(pass, Arc::clone(&threads));
            model.update(&parameters);
            for rows in [1, 11, 13, 96] {
                let (points, pulls) = (cloud(rows, 3), cloud(2 * rows, 4));
                let pulls: Vec<[Point; 2]> = pulls.chunks(2).map(|p| [p[0], p[1]]).collect();
                let mut tiles = model.working_set();
                let mut chunk = model.chunk_gradients();
                let outputs = model.forward(&parameters, &points, 0, &mut tiles).to_vec();
                model.backward(&parameters, &pulls, &mut tiles, &mut chunk);

                let zeros = ReferenceNetwork::read(mlp::zeros().as_slice());
                let mut expected = [zeros.clone(), zeros];
                let normalized = |point: [f64; 3]| {
                    let center = conditioning.center.map(f64::from);
                    [0, 1, 2].map(|a| (point[a] - center[a]) * f64::from(conditioning.scale))
                };
                for (row, (point, pull)) in points.iter().zip(&pulls).enumerate() {
                    let point = point.map(f64::from);
                    let flow = forward.forward(normalized(point));
                    let deformed = [0, 1, 2].map(|a| point[a] + flow[a]);
                    let back = backward.forward(normalized(deformed));
                    for axis in 0..3 {
                        let [f, b] = [outputs[row][0][axis], outputs[row][1][axis]].map(f64::from);
                        assert!((f - flow[axis]).abs() < TOLERANCE, "{f} {flow:?}");
                        assert!((b - back[axis]).abs() < TOLERANCE, "{b} {back:?}");
                    }
                    let [ahead, back] = pull.map(|pull| pull.map(f64::from));
                    let through = backward.backward(normalized(deformed), back, &mut expected[1]);
                    let scale = f64::from(conditioning.scale);
                    let pull = [0, 1, 2].map(|a| ahead[a] + scale * through[a]);
                    forward.backward(normalized(point), pull, &mut expected[0]);
                }
                for (found, expected) in halves(&chunk).iter().zip(&expected) {
                    let (found, expected) = (found.flat(), expected.flat());
                    let scale = expected.iter().fold(0.0f64, |most, g| most.max(g.abs()));
                    for (g, e) in found.iter().zip(&expected) {
                        assert!((g - e).abs() < TOLERANCE * scale, "{isa:?} {rows}: {g} {e}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_gradients_of_the_plain_loop_are_finite_differences_of_its_value() {
        // Central differences in double precision. The step crosses no kink and no change of
        // neighbors.
        const STEP: f64 = 1e-6;
        const TOLERANCE: f64 = 1e-6;
        let (source, target) = (cloud(19, 1), cloud(23, 2));
        let mut networks = halves(&parameters());
        let zeros = ReferenceNetwork::read(mlp::zeros().as_slice());
        let loss = |networks: &[ReferenceNetwork; 2]| {
            let mut gradients = [zeros.clone(), zeros.clone()];
            let [forward, backward] = networks;
            let both = [forward, backward];
            let value = cycle_loss(both, [&source, &target], 2.0, &mut gradients);
            (value, gradients)
        };
        let (_, gradients) = loss(&networks);
        for (layer, output, input) in [(0, 17, 2), (1, 3, 99), (7, 64, 5), (8, 1, 77)] {
            for which in 0..2 {
                let at = networks[which].weights[layer][output][input];
                let mut value = |weight: f64| {
                    networks[which].weights[layer][output][input] = weight;
                    loss(&networks).0
                };
                let slope = (value(at + STEP) - value(at - STEP)) / (2.0 * STEP);
                value(at);
                let expected = gradients[which].weights[layer][output][input];
                let error = (slope - expected).abs();
                assert!(
                    error < TOLERANCE,
                    "network {which}, layer {layer}: {slope} {expected}"
                );
            }
        }
    }
}
