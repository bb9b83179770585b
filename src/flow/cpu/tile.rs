//! The working set of one thread: a tile of points with its activations and their derivatives.

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::flow::field::{Aligned, HIDDEN_LAYERS, MIDDLE_LAYERS, WIDTH, first_layer, tree_sum};

/// Points per tile. The activations of its eight hidden layers fill half of a 1 MiB cache.
pub(crate) const TILE: usize = 96;
/// Rows are padded to a multiple of this number. The row count of every register tile divides it.
pub(super) const ROW_STEP: usize = 12;
/// Floats from one point's features to the next point's. A stride of 128 would map the rows to few
/// cache sets.
pub(super) const STRIDE: usize = WIDTH + 16;
/// Partial sums of a sum over the features, independent of the register width.
pub(super) const SIDE_BY_SIDE: usize = 16;

/// The working set of one thread: a tile's inputs, activations and deltas.
pub(crate) struct Tile {
    /// Points in the tile, at most [`TILE`].
    pub(super) rows: usize,
    /// Network inputs, x y z per point.
    pub(crate) inputs: [[f32; 3]; TILE],
    /// Network outputs of the last forward pass, metres.
    pub(crate) outputs: [[f32; 3]; TILE],
    /// Derivative of the loss with respect to each output, input of the backward pass.
    pub(crate) output_gradients: [[f32; 3]; TILE],
    /// Activations of every hidden layer, one row per point.
    pub(super) activations: Aligned,
    /// Derivatives of the loss with respect to the pre-activations of a layer and of the layer
    /// below it.
    pub(super) deltas: [Aligned; 2],
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

    /// Loads up to [`TILE`] inputs. The remaining rows and their gradients are set to zero.
    pub(crate) fn load(&mut self, inputs: impl ExactSizeIterator<Item = [f32; 3]>) {
        assert!(inputs.len() <= TILE, "a tile holds {TILE} points");
        self.rows = inputs.len();
        for (row, input) in self.inputs.iter_mut().zip(inputs) {
            *row = input;
        }
        self.inputs[self.rows..].fill([0.0; 3]);
        self.output_gradients[self.rows..].fill([0.0; 3]);
    }

    /// The derivative of `output_gradients . g(inputs)` with respect to each input, after a backward
    /// pass of the network with `parameters`. Summed alike for all instruction sets.
    pub(super) fn input_gradients(&self, parameters: &[f32]) -> impl Iterator<Item = [f32; 3]> {
        // The backward pass leaves the derivatives of the first layer in the second array, because
        // the number of middle layers is odd.
        const { assert!(MIDDLE_LAYERS % 2 == 1) };
        let deltas = self.deltas[1].as_slice().chunks_exact(STRIDE);
        let weights = &parameters[first_layer().weights..][..3 * WIDTH];
        deltas.take(self.rows).map(|delta| {
            let mut gradient = [0.0; 3];
            for (gradient, weights) in gradient.iter_mut().zip(weights.chunks_exact(WIDTH)) {
                let mut sums = [0.0; SIDE_BY_SIDE];
                let groups = delta[..WIDTH].chunks_exact(SIDE_BY_SIDE);
                for (delta, weights) in groups.zip(weights.chunks_exact(SIDE_BY_SIDE)) {
                    for (sum, (delta, weight)) in sums.iter_mut().zip(delta.iter().zip(weights)) {
                        *sum += delta * weight;
                    }
                }
                *gradient = tree_sum(sums);
            }
            gradient
        })
    }

    /// Number of rows, padded to whole register tiles.
    pub(super) fn padded_rows(&self) -> usize {
        self.rows.next_multiple_of(ROW_STEP)
    }
}

/// One working set per thread.
pub(super) struct WorkingSets<T>(Vec<Mutex<T>>);

impl<T> WorkingSets<T> {
    pub(super) fn new(threads: &rayon::ThreadPool, working_set: impl Fn() -> T) -> Self {
        let threads = threads.current_num_threads();
        Self((0..threads).map(|_| Mutex::new(working_set())).collect())
    }

    /// The calling thread's working set.
    pub(super) fn own(&self) -> MutexGuard<'_, T> {
        let thread = rayon::current_thread_index().unwrap_or(0);
        self.0[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}
