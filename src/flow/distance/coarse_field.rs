//! The far field: a coarse distance transform of the whole grid, for points beyond the band.
//!
//! Its vertices are every 8th (16th, ...) fine vertex. Fine vertices beyond the band take their
//! values from its trilinear interpolation, so distance is continuous there. Coarse distances
//! suffice: they only have to attract distant points to the target. The nearest occupied vertex is
//! found with all occupied vertices rounded to coarse vertices, by separable lower envelopes of
//! parabolas (Felzenszwalb and Huttenlocher 2012). The distance to that vertex is then computed
//! from its fine position. An underestimate beside the band would be raised to the band's radius,
//! and the gradient there would vanish.

use rayon::prelude::*;

use super::grid::{Grid, trilinear};
use crate::flow::data::{Control, Interrupt, control};

/// The most coarse vertices: 8 Mi floats are 32 MiB.
const MAX_VERTICES: usize = 8 << 20;

/// Distances at every `pitch`-th vertex, in metres, nowhere below the band's radius.
#[derive(Debug)]
pub(crate) struct CoarseField {
    /// Fine cells between coarse vertices: a power of two, at least 8.
    pub(crate) pitch: u32,
    pub(crate) vertices: [usize; 3],
    pub(crate) distances: Vec<f32>,
}

impl CoarseField {
    /// The pitch and the vertex counts of the far field over `grid`.
    fn layout(grid: &Grid) -> (u32, [usize; 3]) {
        let mut pitch = 8u32;
        loop {
            let vertices = grid.vertices.map(|n| (n - 1).div_ceil(pitch as usize) + 1);
            if vertices.iter().product::<usize>() <= MAX_VERTICES {
                return (pitch, vertices);
            }
            pitch *= 2;
        }
    }

    /// An upper bound on the bytes that [`Self::build`] takes over `grid`.
    pub(crate) fn bytes_over(grid: &Grid) -> usize {
        let bytes = size_of::<Nearest>() + size_of::<f32>();
        Self::vertices_over(grid) * bytes
    }

    /// Number of coarse vertices over `grid`.
    pub(crate) fn vertices_over(grid: &Grid) -> usize {
        Self::layout(grid).1.iter().product()
    }

    /// Transforms the occupied fine vertices `cells`. Distances below the radius `band_m` are
    /// raised to it. Checks `control` between slabs.
    ///
    /// # Errors
    /// [`Interrupt`] if the control interrupts.
    pub(crate) fn build(
        grid: &Grid,
        cells: &[[u32; 3]],
        band_m: f64,
        control: &dyn Control,
    ) -> Result<Self, Interrupt> {
        let (pitch, vertices) = Self::layout(grid);
        let [_, ny, nz] = vertices;
        let mut nearest = seeds(cells, pitch, vertices);
        nearest.par_chunks_mut(ny * nz).try_for_each_init(
            || (Envelope::default(), vec![Nearest::NONE; ny]),
            |(envelope, line), slab| {
                control::check(control)?;
                for line in slab.chunks_mut(nz) {
                    envelope.transform(line);
                }
                for z in 0..nz {
                    for y in 0..ny {
                        line[y] = slab[y * nz + z];
                    }
                    envelope.transform(line);
                    for y in 0..ny {
                        slab[y * nz + z] = line[y];
                    }
                }
                Ok(())
            },
        )?;
        transform_along_x(&mut nearest, vertices, control)?;
        let beside = Beside {
            cells,
            pitch,
            vertices,
            nearest: &nearest,
        };
        let band = (band_m / grid.cell) as f32;
        let mut distances = vec![0.0; nearest.len()];
        let slabs = distances.par_chunks_mut(ny * nz).enumerate();
        slabs.try_for_each(|(slab, distances)| {
            control::check(control)?;
            for (at, distance) in (slab * ny * nz..).zip(distances) {
                *distance = beside.distance(at, band) * grid.cell as f32;
            }
            Ok(())
        })?;
        Ok(Self {
            pitch,
            vertices,
            distances,
        })
    }

    /// Distance in metres at a position in fine cells from the origin, and its derivative per fine
    /// cell.
    #[inline]
    pub(crate) fn sample(&self, corner: [u32; 3], fraction: [f32; 3]) -> (f32, [f32; 3]) {
        let scale = 1.0 / self.pitch as f32;
        let low = corner.map(|c| (c / self.pitch) as usize);
        let within: [f32; 3] =
            core::array::from_fn(|a| ((corner[a] % self.pitch) as f32 + fraction[a]) * scale);
        let corners = core::array::from_fn(|i| {
            let at = |axis: usize, bit: usize| (low[axis] + bit).min(self.vertices[axis] - 1);
            let (x, y, z) = (at(0, i >> 2), at(1, i >> 1 & 1), at(2, i & 1));
            self.distances[(x * self.vertices[1] + y) * self.vertices[2] + z]
        });
        let (value, slope) = trilinear(corners, within);
        (value, slope.map(|s| s * scale))
    }
}

/// The occupied vertex that a coarse vertex has found as the nearest.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Nearest {
    /// Squared distance in coarse cells, from the coarse vertex that `cell` was rounded to.
    square: f32,
    /// Index of the occupied vertex.
    cell: u32,
}

impl Nearest {
    const NONE: Self = Self {
        square: f32::INFINITY,
        cell: 0,
    };
}

/// The nearest occupied vertices found, for computing the distances from their fine positions.
struct Beside<'a> {
    cells: &'a [[u32; 3]],
    pitch: u32,
    vertices: [usize; 3],
    nearest: &'a [Nearest],
}

impl Beside<'_> {
    /// Distance of coarse vertex `at` in fine cells, at least `band`. Beside the band, where an
    /// error would make a step, the vertices found by the neighboring coarse vertices are tried as
    /// well.
    fn distance(&self, at: usize, band: f32) -> f32 {
        let [nx, ny, nz] = self.vertices;
        let coarse = [at / (ny * nz), at / nz % ny, at % nz];
        let vertex = coarse.map(|v| v as u32 * self.pitch);
        let to = |at: usize| length(vertex, self.cells[self.nearest[at].cell as usize]);
        let own = to(at);
        if own <= band || own > band + 3.0 * self.pitch as f32 {
            return own.max(band);
        }
        let around = |axis: usize, count: usize| {
            coarse[axis].saturating_sub(1)..=(coarse[axis] + 1).min(count - 1)
        };
        let mut least = own;
        for x in around(0, nx) {
            for y in around(1, ny) {
                for z in around(2, nz) {
                    least = least.min(to((x * ny + y) * nz + z));
                }
            }
        }
        least.max(band)
    }
}

/// Rounds every occupied vertex to the nearest coarse vertex, which keeps the closest one.
fn seeds(cells: &[[u32; 3]], pitch: u32, [nx, ny, nz]: [usize; 3]) -> Vec<Nearest> {
    let mut nearest = vec![Nearest::NONE; nx * ny * nz];
    for (number, &cell) in (0..).zip(cells) {
        let coarse = cell.map(|c| (c + pitch / 2) / pitch);
        let [x, y, z] = coarse.map(|c| c as usize);
        let seed = &mut nearest[(x * ny + y) * nz + z];
        let gap = |number: u32| length(coarse.map(|c| c * pitch), cells[number as usize]);
        if *seed == Nearest::NONE || gap(number) < gap(seed.cell) {
            *seed = Nearest {
                square: 0.0,
                cell: number,
            };
        }
    }
    nearest
}

/// Distance between two fine vertices, in cells.
fn length(a: [u32; 3], b: [u32; 3]) -> f32 {
    let square = |axis: usize| (a[axis].abs_diff(b[axis]) as f32).powi(2);
    (square(0) + square(1) + square(2)).sqrt()
}

/// The last pass. Each `y` slice is processed in a copy with x innermost, because columns along x
/// are too far apart in memory to be read one by one.
fn transform_along_x(
    nearest: &mut [Nearest],
    [nx, ny, nz]: [usize; 3],
    control: &dyn Control,
) -> Result<(), Interrupt> {
    let mut columns = vec![Nearest::NONE; nz * nx];
    for y in 0..ny {
        control::check(control)?;
        let row = |x: usize| (x * ny + y) * nz..(x * ny + y + 1) * nz;
        for x in 0..nx {
            for (z, &nearest) in nearest[row(x)].iter().enumerate() {
                columns[z * nx + x] = nearest;
            }
        }
        columns
            .par_chunks_mut(nx)
            .for_each_init(Envelope::default, |envelope, line| {
                envelope.transform(line);
            });
        for x in 0..nx {
            for (z, nearest) in nearest[row(x)].iter_mut().enumerate() {
                *nearest = columns[z * nx + x];
            }
        }
    }
    Ok(())
}

/// The lower envelope of unit parabolas: the one-dimensional squared distance transform.
#[derive(Default)]
struct Envelope {
    sources: Vec<(usize, Nearest)>,
    starts: Vec<f32>,
}

impl Envelope {
    /// Replaces `line[i]` by the `line[j]` with the least `(i - j)^2 + line[j].square`.
    fn transform(&mut self, line: &mut [Nearest]) {
        self.sources.clear();
        self.starts.clear();
        for (index, &source) in line.iter().enumerate() {
            if source.square == f32::INFINITY {
                continue;
            }
            let mut start = f32::NEG_INFINITY;
            while let Some(&(last, last_source)) = self.sources.last() {
                // The intersection is computed without squared indices, which on long lines would
                // cancel the significant digits of the heights.
                let (rise, run) = (source.square - last_source.square, (index - last) as f32);
                start = (rise / run + (index + last) as f32) / 2.0;
                if self.starts.last().is_some_and(|&begin| start <= begin) {
                    self.sources.pop();
                    self.starts.pop();
                } else {
                    break;
                }
            }
            if self.sources.is_empty() {
                start = f32::NEG_INFINITY;
            }
            self.sources.push((index, source));
            self.starts.push(start);
        }
        if self.sources.is_empty() {
            return;
        }
        let mut current = 0;
        for (index, nearest) in line.iter_mut().enumerate() {
            let at = index as f32;
            while current + 1 < self.starts.len() && self.starts[current + 1] < at {
                current += 1;
            }
            let (source, best) = self.sources[current];
            nearest.square = (at - source as f32).powi(2) + best.square;
            nearest.cell = best.cell;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn transformed(squares: &[f32]) -> Vec<Nearest> {
        let mut line: Vec<_> = (0..)
            .zip(squares)
            .map(|(cell, &square)| Nearest { square, cell })
            .collect();
        Envelope::default().transform(&mut line);
        line
    }

    fn check(squares: &[f32], indices: impl Iterator<Item = usize>) {
        let fast = transformed(squares);
        for i in indices {
            let at = |j: usize| (i as f64 - j as f64).powi(2) + f64::from(squares[j]);
            let slow = (0..squares.len()).map(at).fold(f64::INFINITY, f64::min);
            assert_eq!(f64::from(fast[i].square), slow, "at {i}");
            assert_eq!(at(fast[i].cell as usize), slow, "at {i}");
        }
    }

    #[test]
    fn the_envelope_is_the_minimum_over_all_parabolas() {
        let inf = f32::INFINITY;
        let line = [inf, 4.0, inf, inf, 0.0, 9.0, inf, inf, inf, 1.0, inf];
        check(&line, 0..line.len());
    }

    #[test]
    fn the_far_end_of_a_long_line_is_as_exact_as_its_beginning() {
        let mut line = vec![f32::INFINITY; 30_000];
        for index in (0..line.len()).step_by(7) {
            line[index] = (index * 31 % 97) as f32;
        }
        check(&line, (0..100).chain(29_900..30_000));
    }

    #[test]
    fn an_empty_line_stays_empty() {
        let line = transformed(&[f32::INFINITY; 5]);
        assert!(line.iter().all(|nearest| nearest.square.is_infinite()));
    }
}
