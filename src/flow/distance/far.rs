//! The far field: a coarse distance transform of the whole grid, for points beyond the band.
//!
//! Its vertices are every 8th (16th, ...) fine vertex, so that its trilinear interpolation at fine
//! vertices joins the band without a seam. Coarse on purpose: it only has to pull a lost point
//! home. Separable lower envelopes of parabolas (Felzenszwalb and Huttenlocher 2012).

use rayon::prelude::*;

use super::grid::{Grid, trilinear};

/// The most coarse vertices: 8 M floats are 32 MB.
const MAX_VERTICES: usize = 8 << 20;

/// Distances at every `pitch`-th vertex, in metres, nowhere below the band's radius.
#[derive(Debug)]
pub(crate) struct FarField {
    /// Fine cells between coarse vertices: a power of two, at least 8.
    pub(crate) pitch: u32,
    pub(crate) vertices: [usize; 3],
    pub(crate) distances: Vec<f32>,
}

impl FarField {
    /// The coarse vertices over `grid`: pitch and counts.
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

    /// Bytes that [`Self::build`] will take over `grid`.
    pub(crate) fn bytes_over(grid: &Grid) -> usize {
        Self::layout(grid).1.iter().product::<usize>() * size_of::<f32>()
    }

    /// Transforms the occupied fine vertices `cells`; distances below `band_m` are raised to it.
    pub(crate) fn build(grid: &Grid, cells: &[[u32; 3]], band_m: f64) -> Self {
        let (pitch, vertices) = Self::layout(grid);
        let [nx, ny, nz] = vertices;
        let mut squares = vec![f32::INFINITY; nx * ny * nz];
        for cell in cells {
            let [x, y, z] = cell.map(|c| ((c + pitch / 2) / pitch) as usize);
            squares[(x.min(nx - 1) * ny + y.min(ny - 1)) * nz + z.min(nz - 1)] = 0.0;
        }
        squares
            .par_chunks_mut(nz)
            .for_each_init(Envelope::default, |envelope, line| {
                envelope.transform(line);
            });
        squares.par_chunks_mut(ny * nz).for_each_init(
            || (Envelope::default(), vec![0.0; ny]),
            |(envelope, line), slab| {
                for z in 0..nz {
                    for y in 0..ny {
                        line[y] = slab[y * nz + z];
                    }
                    envelope.transform(line);
                    for y in 0..ny {
                        slab[y * nz + z] = line[y];
                    }
                }
            },
        );
        let mut envelope = Envelope::default();
        let mut line = vec![0.0; nx];
        for column in 0..ny * nz {
            for x in 0..nx {
                line[x] = squares[x * ny * nz + column];
            }
            envelope.transform(&mut line);
            for x in 0..nx {
                squares[x * ny * nz + column] = line[x];
            }
        }
        let scale = (grid.cell * f64::from(pitch)) as f32;
        let mut distances = squares;
        for distance in &mut distances {
            *distance = (distance.sqrt() * scale).max(band_m as f32);
        }
        Self {
            pitch,
            vertices,
            distances,
        }
    }

    /// Distance at a place given in fine cells from the origin, and its derivative by fine cells.
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

/// The lower envelope of unit parabolas: the one-dimensional squared distance transform.
#[derive(Default)]
struct Envelope {
    sources: Vec<(usize, f32)>,
    starts: Vec<f32>,
}

impl Envelope {
    /// Replaces `line[i]` by `min over j of (i - j)^2 + line[j]`.
    fn transform(&mut self, line: &mut [f32]) {
        self.sources.clear();
        self.starts.clear();
        for (place, &height) in line.iter().enumerate() {
            if height == f32::INFINITY {
                continue;
            }
            let mut start = f32::NEG_INFINITY;
            while let Some(&(last, last_height)) = self.sources.last() {
                let (p, q) = (place as f32, last as f32);
                start = ((height + p * p) - (last_height + q * q)) / (2.0 * (p - q));
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
            self.sources.push((place, height));
            self.starts.push(start);
        }
        if self.sources.is_empty() {
            return;
        }
        let mut current = 0;
        for (place, value) in line.iter_mut().enumerate() {
            let at = place as f32;
            while current + 1 < self.starts.len() && self.starts[current + 1] < at {
                current += 1;
            }
            let (source, height) = self.sources[current];
            *value = (at - source as f32).powi(2) + height;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_envelope_is_the_minimum_over_all_parabolas() {
        let inf = f32::INFINITY;
        let line = [inf, 4.0, inf, inf, 0.0, 9.0, inf, inf, inf, 1.0, inf];
        let mut fast = line;
        Envelope::default().transform(&mut fast);
        for (i, value) in fast.iter().enumerate() {
            let slow = (0..line.len())
                .map(|j| (i as f32 - j as f32).powi(2) + line[j])
                .fold(inf, f32::min);
            assert_eq!(*value, slow, "at {i}");
        }
    }

    #[test]
    fn an_empty_line_stays_empty() {
        let mut line = [f32::INFINITY; 5];
        Envelope::default().transform(&mut line);
        assert!(line.iter().all(|v| v.is_infinite()));
    }
}
