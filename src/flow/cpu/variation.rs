//! The total variation of the linear model's displacements (FNSF's published code), on the CPU.
//!
//! It is the sum over the vertices and the axes of the flow of `sqrt(1e-5 + |differences|^2)`, with
//! the differences to the next vertices along x, y and z. Vertices without a next one along every
//! axis are left out.

use rayon::prelude::*;

use crate::flow::field::{LinearGrid, VARIATION_SMOOTHING, reduction};

/// The total variation of the current displacements.
pub(super) struct Variation {
    /// Reciprocal length of the displacement's differences at each vertex, for each axis of the
    /// displacement. Zero where a vertex is left out.
    inverse_lengths: Vec<f32>,
    /// Sum of the lengths.
    pub(super) sum: f32,
}

impl Variation {
    /// That of a displacement of `floats` values, before the first [`Self::measure`].
    pub(super) fn new(floats: usize) -> Self {
        Self {
            inverse_lengths: vec![0.0; floats],
            sum: 0.0,
        }
    }

    /// Computes it for the displacements `values`. `lengths`, of the same size, is overwritten.
    pub(super) fn measure(
        &mut self,
        grid: &LinearGrid,
        values: &[f32],
        lengths: &mut [f32],
        threads: &rayon::ThreadPool,
    ) {
        let [x, y, z] = grid.vertices;
        let (row, plane, inner) = (grid.row(), grid.plane(), x - 1);
        let level = |(number, (inverse, lengths)): (usize, (&mut [f32], &mut [f32]))| {
            inverse.fill(0.0);
            lengths.fill(0.0);
            if number % z + 1 == z {
                return;
            }
            let values = &values[number * plane..];
            for at in (0..y - 1).map(|across| across * row) {
                let next = [1, row, plane].map(|step| &values[at + step..][..inner]);
                let (inverse, lengths) = (&mut inverse[at..], &mut lengths[at..]);
                measure_row(&values[at..][..inner], next, &mut inverse[..inner], lengths);
            }
        };
        threads.install(|| {
            let levels = self.inverse_lengths.par_chunks_mut(plane);
            let levels = levels.zip(lengths.par_chunks_mut(plane));
            levels.enumerate().for_each(level);
        });
        self.sum = reduction::sum(lengths);
    }

    /// Adds `weight` times its derivative with respect to one level of `values` to `out`. The
    /// levels of all axes of the flow are numbered one after the other.
    pub(super) fn add_gradient(
        &self,
        grid: &LinearGrid,
        values: &[f32],
        number: usize,
        weight: f32,
        out: &mut [f32],
    ) {
        let [x, y, z] = grid.vertices;
        let (row, plane, inner) = (grid.row(), grid.plane(), x - 1);
        let level = number % z;
        let mut sums = vec![0.0; x];
        for across in 0..y {
            sums.fill(0.0);
            let at = number * plane + across * row;
            let own = &values[at..][..x];
            let before = |step: usize| {
                let from = at - step;
                [&values[from..][..x], &self.inverse_lengths[from..][..x]]
            };
            // The differences from the vertices before along x, y and z.
            let lower = [&own[..inner], &self.inverse_lengths[at..][..inner]];
            add_differences(&mut sums[1..], &own[1..], lower);
            if across > 0 {
                add_differences(&mut sums, own, before(row));
            }
            if level > 0 {
                add_differences(&mut sums, own, before(plane));
            }
            if across + 1 < y && level + 1 < z {
                let next = [1, row, plane].map(|step| &values[at + step..][..inner]);
                subtract_ahead(&mut sums[..inner], lower, next);
            }
            let out = &mut out[across * row..][..x];
            for (out, sum) in out.iter_mut().zip(&sums) {
                *out += weight * sum;
            }
        }
    }
}

/// The lengths of the differences from each of `own` to the vertices `next` along the axes, and
/// their reciprocals.
fn measure_row(own: &[f32], next: [&[f32]; 3], inverse: &mut [f32], lengths: &mut [f32]) {
    let [right, up, above] = next;
    let out = inverse.iter_mut().zip(lengths);
    let next = right.iter().zip(up).zip(above);
    for ((own, ((right, up), above)), (inverse, length)) in own.iter().zip(next).zip(out) {
        let [x, y, z] = [right - own, up - own, above - own];
        *length = (VARIATION_SMOOTHING + (x * x + y * y + z * z)).sqrt();
        *inverse = 1.0 / *length;
    }
}

/// Adds the differences of `own` from the vertices before, times the reciprocal lengths there.
fn add_differences(sums: &mut [f32], own: &[f32], [before, inverse]: [&[f32]; 2]) {
    let before = before.iter().zip(inverse);
    for ((sum, own), (before, inverse)) in sums.iter_mut().zip(own).zip(before) {
        *sum += (own - before) * inverse;
    }
}

/// Subtracts the sum of the differences from each of `own` to `next`, times its reciprocal length.
fn subtract_ahead(sums: &mut [f32], [own, inverse]: [&[f32]; 2], next: [&[f32]; 3]) {
    let [right, up, above] = next;
    let own = own.iter().zip(inverse);
    let next = right.iter().zip(up).zip(above);
    for ((sum, (own, inverse)), ((right, up), above)) in sums.iter_mut().zip(own).zip(next) {
        let ahead = (right - own) + (up - own) + (above - own);
        *sum -= ahead * inverse;
    }
}
