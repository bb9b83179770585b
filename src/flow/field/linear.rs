//! The linear model of FNSF's comparison: a complex positional encoding (Zheng et al. 2022) on a
//! grid of voxels.
//!
//! With Gaussians `phi_a[i][j] = exp(-(x_i - x_j)^2 / (2 sigma^2)) / scale_a` between the vertices
//! of an axis and one weight `W` for each vertex and axis of the flow, the flow at the vertices is
//! `V = (phi_x (x) phi_y (x) phi_z) W`. It is computed as three products along the axes, so the
//! Kronecker product is never formed. The flow of a point is blended from the 8 vertices around it.
//! With `k(d) = exp(-d^2 / (4 sigma^2))`, a vertex at distance `t` along an axis, its neighbor at
//! `s - t` and the voxel's edge `s`, its weight is `(k(t) - k(s - t) k(s)) / (1 - k(s)^2)`.
//!
//! Strides and origin are those of the paper's formulas. The published code mixes up both.

use rayon::prelude::*;

use crate::flow::data::{Body, EnvelopeError, Point, Random};
use crate::flow::options::LinearOptions;

/// Floats that rows along x are padded to: a register of every instruction set.
pub(crate) const ROW: usize = 16;
/// Arrays of the grid's size that a fit holds: weights, their gradients and moments, the result, the
/// displacements with their gradients, and two of the products.
const ARRAYS: usize = 9;
/// Values of a Gaussian below this share of its peak count as zero. They are below the rounding of
/// single precision, and numbers too small for its normal range make a processor many times slower.
const NEGLIGIBLE: f64 = 1e-9;
/// Smoothing constant of the total variation, square metres, as in the published code.
pub(crate) const VARIATION_SMOOTHING: f32 = 1e-5;
/// Most vertices along an axis.
const MOST_VERTICES: f64 = 65_536.0;

/// The grid of a linear model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LinearGrid {
    /// The vertex with the lowest coordinates, metres.
    pub(crate) origin: Point,
    /// Distance between neighboring vertices, metres.
    pub(crate) voxel_m: f32,
    /// Standard deviation of the Gaussians, metres.
    pub(crate) sigma_m: f32,
    /// Number of vertices along x, y and z.
    pub(crate) vertices: [usize; 3],
}

/// Why a linear model is not possible.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum LinearError {
    /// The voxel is not a number of metres, or less than 0.01 m.
    #[error("a voxel of {voxel_m} m is not possible: choose at least 0.01 m")]
    Voxel {
        /// The requested edge, metres.
        voxel_m: f32,
    },
    /// The Gaussians are not 0.5 to 100 voxels wide.
    #[error(
        "a sigma of {sigma_m} m with voxels of {voxel_m} m is not possible: choose 0.5 to 100 voxels"
    )]
    Sigma {
        /// The requested standard deviation, metres.
        sigma_m: f32,
        /// The voxel's edge, metres.
        voxel_m: f32,
    },
    /// The weight of the total variation is negative or not finite.
    #[error("a weight of {weight} for the total variation is not possible: choose 0 or more")]
    VariationWeight {
        /// The requested weight.
        weight: f32,
    },
    /// The grid would take more memory than [`LinearOptions::max_bytes`].
    #[error(
        "the grid of the linear model needs {needed} bytes, {limit} are allowed: choose larger voxels or crop with crop_m"
    )]
    Memory {
        /// Bytes needed, or a lower bound.
        needed: usize,
        /// Bytes allowed.
        limit: usize,
    },
}

/// Checks the values of `options`, without the memory limit.
///
/// # Errors
/// [`LinearError`] for a value out of range.
pub(super) fn check_linear(options: &LinearOptions) -> Result<(), LinearError> {
    let LinearOptions {
        voxel_m,
        sigma_m,
        variation_weight: weight,
        ..
    } = *options;
    if !(voxel_m >= 0.01 && voxel_m.is_finite()) {
        return Err(LinearError::Voxel { voxel_m });
    }
    if !(0.5..=100.0).contains(&(sigma_m / voxel_m)) {
        return Err(LinearError::Sigma { sigma_m, voxel_m });
    }
    if !(weight >= 0.0 && weight.is_finite()) {
        return Err(LinearError::VariationWeight { weight });
    }
    Ok(())
}

impl LinearGrid {
    /// The grid over `points`, one to two voxels beyond them on each side.
    ///
    /// # Errors
    /// [`LinearError`] if an option is out of range or the grid needs too much memory.
    pub(crate) fn plan(points: &[Point], options: &LinearOptions) -> Result<Self, LinearError> {
        check_linear(options)?;
        let LinearOptions {
            voxel_m,
            sigma_m,
            max_bytes: limit,
            ..
        } = *options;
        let voxel = f64::from(voxel_m);
        let axis = |axis: usize| {
            let values = points.iter().map(|point| f64::from(point[axis]));
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| {
                (low.min(x), high.max(x))
            });
            let low = (low / voxel - 1.0).floor();
            let high = (high / voxel + 1.0).ceil();
            (low * voxel, high - low + 1.0)
        };
        let axes = [axis(0), axis(1), axis(2)];
        let counts = axes.map(|(_, count)| count);
        // A count that is not a number, or negative as that of no points, does not fit either.
        let fits = counts
            .iter()
            .all(|count| (2.0..=MOST_VERTICES).contains(count));
        let needed = if fits {
            let vertices = counts.map(|count| count as usize);
            Self::bytes_of(vertices)
        } else {
            usize::MAX
        };
        if needed > limit {
            return Err(LinearError::Memory { needed, limit });
        }
        Ok(Self {
            origin: axes.map(|(low, _)| low as f32),
            voxel_m,
            sigma_m,
            vertices: counts.map(|count| count as usize),
        })
    }

    /// Bytes of a fit with a grid of so many vertices.
    fn bytes_of(vertices: [usize; 3]) -> usize {
        let encodings: usize = vertices
            .iter()
            .map(|count| count * count.next_multiple_of(ROW))
            .sum();
        let [x, y, z] = vertices;
        let values = (x.next_multiple_of(ROW) * y).saturating_mul(3 * z);
        values
            .saturating_mul(ARRAYS)
            .saturating_add(encodings)
            .saturating_mul(size_of::<f32>())
    }

    /// Bytes of a fit with this grid.
    pub(crate) fn bytes(&self) -> usize {
        Self::bytes_of(self.vertices)
    }

    /// Floats from one vertex along y to the next.
    pub(crate) fn row(&self) -> usize {
        self.vertices[0].next_multiple_of(ROW)
    }

    /// Floats of a plane of vertices with the same z.
    pub(crate) fn plane(&self) -> usize {
        self.row() * self.vertices[1]
    }

    /// Floats of the values of one axis of the flow.
    pub(crate) fn channel(&self) -> usize {
        self.plane() * self.vertices[2]
    }

    /// A weight of the total variation over the number of vertices that it is a mean of: those with
    /// a next neighbor along all axes.
    pub(crate) fn variation_share(&self, weight: f32) -> f32 {
        let inner: usize = self.vertices.iter().map(|count| count - 1).product();
        weight / inner as f32
    }

    /// Multiply-adds of the three products.
    pub(crate) fn product_work(&self) -> f64 {
        let along: usize = self.vertices.iter().sum();
        3.0 * self.channel() as f64 * along as f64
    }

    /// Floats of a row of [`Self::encoding`].
    pub(crate) fn encoding_row(&self, axis: usize) -> usize {
        self.vertices[axis].next_multiple_of(ROW)
    }

    /// The encoding of an axis: a symmetric matrix with rows padded to [`ROW`] floats. It is divided
    /// by the largest length of its rows.
    pub(crate) fn encoding(&self, axis: usize) -> Vec<f32> {
        let count = self.vertices[axis];
        let stride = self.encoding_row(axis);
        let voxels = f64::from(self.sigma_m) / f64::from(self.voxel_m);
        let gaussian = |i: usize, j: usize| {
            let off = i.abs_diff(j) as f64 / voxels;
            let value = (-0.5 * off * off).exp();
            if value < NEGLIGIBLE { 0.0 } else { value }
        };
        let length = |i: usize| {
            (0..count)
                .map(|j| gaussian(i, j).powi(2))
                .sum::<f64>()
                .sqrt()
        };
        let scale = (0..count).map(length).fold(0.0, f64::max);
        let mut matrix = vec![0.0; count * stride];
        for i in 0..count {
            for j in 0..count {
                matrix[i * stride + j] = (gaussian(i, j) / scale) as f32;
            }
        }
        matrix
    }

    /// The initial weights, uniform in `U(-a, a)` with `a = 1 / sqrt(3)`, as in the published code.
    /// The padding is zero.
    pub(crate) fn initial(&self, random: &mut Random, weights: &mut [f32]) {
        let bound = 1.0 / 3f64.sqrt();
        for row in weights.chunks_mut(self.row()).take(self.rows()) {
            for weight in &mut row[..self.vertices[0]] {
                *weight = random.uniform(-bound, bound) as f32;
            }
        }
    }

    /// Rows of all three axes of the flow.
    pub(crate) fn rows(&self) -> usize {
        3 * self.vertices[1] * self.vertices[2]
    }
}

/// The fitted linear model of one pair: displacements at the vertices of a grid, from which those of
/// all points are blended.
///
/// It maps a position to the displacement in one sweep interval, both in metres. Beyond the grid the
/// displacement is that at the nearest position on its border. With an ego motion, the position is a
/// source point after the ego motion, and the displacement is the residual flow.
#[derive(Clone)]
pub struct LinearField {
    pub(crate) grid: LinearGrid,
    /// The displacements of all vertices, metres: those along x, then y, then z.
    pub(crate) values: Vec<f32>,
}

impl LinearField {
    /// The flow at each of the N `points`, N x 3 displacements in metres.
    pub(crate) fn flow(&self, points: &[Point], threads: &rayon::ThreadPool) -> Vec<Point> {
        let flow = |&point: &Point| self.grid.place(point).blend(&self.grid, &self.values);
        threads.install(|| points.par_iter().map(flow).collect())
    }

    /// Appends the field to `bytes`.
    pub(crate) fn put(&self, bytes: &mut Vec<u8>) {
        let LinearGrid {
            origin,
            voxel_m,
            sigma_m,
            vertices,
        } = self.grid;
        for value in origin.into_iter().chain([voxel_m, sigma_m]) {
            bytes.extend(value.to_le_bytes());
        }
        for count in vertices {
            bytes.extend((count as u64).to_le_bytes());
        }
        bytes.extend(self.values.iter().flat_map(|value| value.to_le_bytes()));
    }

    /// Reads the output of [`Self::put`]. Allocates nothing if bytes are missing.
    ///
    /// # Errors
    /// [`EnvelopeError::Damaged`] if bytes are missing, or the grid is not a possible one.
    pub(crate) fn take(body: &mut Body<'_>) -> Result<Self, EnvelopeError> {
        let origin = [body.single()?, body.single()?, body.single()?];
        let (voxel_m, sigma_m) = (body.single()?, body.single()?);
        let vertices = [body.count()?, body.count()?, body.count()?];
        let positive = |value: f32| value > 0.0 && value.is_finite();
        let possible = vertices
            .iter()
            .all(|&count| (2..=MOST_VERTICES as usize).contains(&count));
        let wide = (0.5..=100.0).contains(&(sigma_m / voxel_m));
        if !positive(voxel_m) || !wide || !possible {
            return Err(EnvelopeError::Damaged);
        }
        let grid = LinearGrid {
            origin,
            voxel_m,
            sigma_m,
            vertices,
        };
        let floats = 3 * grid.channel();
        if body.bytes_left() / size_of::<f32>() < floats {
            return Err(EnvelopeError::Damaged);
        }
        let mut values = Vec::with_capacity(floats);
        for _ in 0..floats {
            values.push(body.single()?);
        }
        Ok(Self { grid, values })
    }
}

impl core::fmt::Debug for LinearField {
    fn fmt(&self, formatter: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        formatter
            .debug_struct("LinearField")
            .field("grid", &self.grid)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_and_clouds_that_are_not_possible_are_refused_before_memory_is_taken() {
        let cloud = [[0.0; 3], [50.0, 40.0, 3.0]];
        let usual = LinearOptions::published();
        let refused = |options: LinearOptions, cloud: &[Point]| {
            LinearGrid::plan(cloud, &options).expect_err("refused")
        };
        for voxel_m in [0.0, 1e-9, -1.0, f32::NAN, f32::INFINITY] {
            let error = refused(LinearOptions { voxel_m, ..usual }, &cloud);
            assert!(matches!(error, LinearError::Voxel { .. }), "{error}");
        }
        for sigma_m in [0.0, -5.0, 0.9, 201.0, f32::NAN] {
            let error = refused(LinearOptions { sigma_m, ..usual }, &cloud);
            assert!(matches!(error, LinearError::Sigma { .. }), "{error}");
        }
        for variation_weight in [-0.1, f32::NAN, f32::INFINITY] {
            let options = LinearOptions {
                variation_weight,
                ..usual
            };
            let error = refused(options, &cloud);
            assert!(
                matches!(error, LinearError::VariationWeight { .. }),
                "{error}"
            );
        }
        let fine = LinearOptions {
            voxel_m: 0.01,
            sigma_m: 0.02,
            ..usual
        };
        let far = [[0.0; 3], [1e30, 0.0, 0.0]];
        let stray = [[0.0; 3], [f32::NAN, 0.0, 0.0], [f32::INFINITY, 0.0, 0.0]];
        for error in [
            refused(fine, &cloud),
            refused(usual, &far),
            refused(usual, &stray),
            refused(usual, &[]),
        ] {
            assert!(matches!(error, LinearError::Memory { .. }), "{error}");
        }
    }
}
