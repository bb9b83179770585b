//! The working set of each thread: a tile of points with its activations and deltas.
//!
//! Knows where things lie; computes nothing.

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::flow::field::{Aligned, HIDDEN_LAYERS, WIDTH};

/// Points in one tile: eight rows of activations of 96 points fill half of a 1 MiB cache.
pub(crate) const TILE: usize = 96;
/// Rows are padded to a multiple of this, which every kernel's row count divides.
pub(super) const ROW_STEP: usize = 12;
/// Floats from one point's features to the next point's: 128 would map rows onto few cache sets.
pub(super) const STRIDE: usize = WIDTH + 16;

/// The working set of one thread: a tile's inputs, activations and deltas.
pub(crate) struct Tile {
    /// Points in the tile, at most [`TILE`].
    pub(super) rows: usize,
    /// Network inputs, x y z a point.
    pub(crate) inputs: [[f32; 3]; TILE],
    /// Network outputs of the last forward pass.
    pub(crate) outputs: [[f32; 3]; TILE],
    /// The loss's derivative by each output, read by the backward pass.
    pub(crate) output_gradients: [[f32; 3]; TILE],
    /// Rows of every hidden layer.
    pub(super) activations: Aligned,
    /// Loss derivatives by one layer's and the next lower layer's linear parts.
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

    /// Rows including the padding to whole register tiles.
    pub(super) fn padded_rows(&self) -> usize {
        self.rows.next_multiple_of(ROW_STEP)
    }
}

/// One working set a thread.
pub(super) struct WorkingSets(Vec<Mutex<Tile>>);

impl WorkingSets {
    pub(super) fn new(threads: &rayon::ThreadPool) -> Self {
        let threads = threads.current_num_threads();
        Self((0..threads).map(|_| Mutex::new(Tile::new())).collect())
    }

    /// The calling thread's.
    pub(super) fn own(&self) -> MutexGuard<'_, Tile> {
        let thread = rayon::current_thread_index().unwrap_or(0);
        self.0[thread]
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}
