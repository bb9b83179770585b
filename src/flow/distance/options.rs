//! Options and errors of the distance transform, checked before memory is allocated.

use crate::flow::data::Interrupt;

/// The distance metric.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    /// Euclidean distance, see [`super::Bricks`]: exact at the grid's vertices within the band,
    /// approximate beyond it.
    Euclidean,
    /// The published code's chamfer metric on a dense grid, see [`super::DenseChamfer`]: up to
    /// 12.8% too long.
    Chamfer,
}

/// The sites that distances are measured to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sites {
    /// The grid vertices nearest to the target's points, as published.
    Cells,
    /// The target's points themselves.
    Points,
}

/// Options of the distance transform. They are checked when a transform is built or its cost is
/// predicted.
#[derive(Clone, Debug, PartialEq)]
pub struct DistanceOptions {
    /// The distance metric. Default: [`Metric::Euclidean`].
    pub metric: Metric,
    /// The sites that distances are measured to. Used by [`Metric::Euclidean`] only. Default:
    /// [`Sites::Cells`].
    pub sites: Sites,
    /// Edge of a cell, metres, at least 0.001. Default: 0.1, as in FNSF Section 4.
    pub cell_m: f64,
    /// Radius of the band around the target in which distances are exact, metres. It is rounded to
    /// whole cells, and must then be 1 to [`Self::MAX_BAND_CELLS`] cells. It is checked for
    /// [`Metric::Chamfer`] too, which has no band. Default: 2.
    pub band_m: f64,
    /// Limit on the memory of the transform, bytes. If more is needed, the build fails with
    /// [`DistanceError::Memory`]. For [`Metric::Euclidean`] it includes the working memory of the
    /// build, except for 12 bytes a target point and small buffers of each thread. Default: 8 GiB.
    pub max_bytes: usize,
}

impl DistanceOptions {
    /// The largest radius of the band, in cells. It keeps squared distances, in square cells,
    /// within 16-bit integers.
    pub const MAX_BAND_CELLS: f64 = 64.0;

    /// Sets the edge of a cell, metres, and fits the band to the cells that it may have.
    pub fn set_cell(&mut self, cell_m: f64) {
        self.cell_m = cell_m;
        let widest = cell_m * Self::MAX_BAND_CELLS;
        self.band_m = self.band_m.min(widest).max(cell_m);
    }

    /// The band's radius in whole cells.
    pub(crate) fn band_cells(&self) -> i32 {
        (self.band_m / self.cell_m).round() as i32
    }

    /// Checks that the sizes are positive and finite, and that the band is 1 to 64 cells wide.
    pub(crate) fn check(&self) -> Result<(), DistanceError> {
        let positive = |x: f64| x.is_finite() && x > 0.0;
        if !positive(self.cell_m) || self.cell_m < 1e-3 {
            return Err(DistanceError::Cell {
                cell_m: self.cell_m,
            });
        }
        let cells = self.band_m / self.cell_m;
        if !positive(self.band_m) || !(1.0..=Self::MAX_BAND_CELLS).contains(&cells.round()) {
            return Err(DistanceError::Band {
                band_m: self.band_m,
                cell_m: self.cell_m,
            });
        }
        Ok(())
    }
}

impl Default for DistanceOptions {
    fn default() -> Self {
        Self {
            metric: Metric::Euclidean,
            sites: Sites::Cells,
            cell_m: 0.1,
            band_m: 2.0,
            max_bytes: 8 << 30,
        }
    }
}

/// Why a distance transform, its grid or the prediction of its cost failed.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum DistanceError {
    /// [`DistanceOptions::cell_m`] is not finite, or below 0.001 m.
    #[error("a cell of {cell_m} m is not possible: choose at least 0.001 m")]
    Cell {
        /// The requested edge, metres.
        cell_m: f64,
    },
    /// [`DistanceOptions::band_m`] is not finite, or, rounded to whole cells, is not 1 to 64 cells.
    #[error("a band of {band_m} m with cells of {cell_m} m is not possible: choose 1 to 64 cells")]
    Band {
        /// The requested radius, metres.
        band_m: f64,
        /// The cell's edge, metres.
        cell_m: f64,
    },
    /// The target cloud has no points.
    #[error("the target cloud is empty")]
    EmptyTarget,
    /// Both clouds together span more than [`super::Grid::MAX_EXTENT_M`] along an axis, or a
    /// coordinate is infinite.
    #[error(
        "the clouds span {x_m:.0} x {y_m:.0} x {z_m:.0} m, more than {limit_m:.0} m on an axis: \
         remove stray points or crop with crop_m"
    )]
    Extent {
        /// Extent along x, metres.
        x_m: f64,
        /// Extent along y, metres.
        y_m: f64,
        /// Extent along z, metres.
        z_m: f64,
        /// The longest extent allowed, metres.
        limit_m: f64,
    },
    /// The transform would take more memory than [`DistanceOptions::max_bytes`], or its grid has
    /// too many vertices for the index of its bricks.
    #[error("the distance transform needs {needed} bytes, {limit} are allowed: crop with crop_m")]
    Memory {
        /// Bytes needed, or a lower bound.
        needed: usize,
        /// Bytes allowed: [`DistanceOptions::max_bytes`], or a fixed limit.
        limit: usize,
    },
    /// The control interrupted the build, for the reason given.
    #[error("the distance transform was interrupted")]
    Interrupted(Interrupt),
}

impl From<Interrupt> for DistanceError {
    fn from(interrupt: Interrupt) -> Self {
        Self::Interrupted(interrupt)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Point;
    use crate::flow::data::Random;
    use crate::flow::data::Uncontrolled;
    use crate::flow::distance::bricks::Bricks;
    use crate::flow::distance::transform::DistanceTransform;

    fn boxed(count: usize, size: [f64; 3]) -> Vec<Point> {
        let mut random = Random::new(1);
        let mut point = || size.map(|side| random.uniform(0.0, side) as f32);
        (0..count).map(|_| point()).collect()
    }

    #[test]
    fn clouds_that_span_too_much_are_refused() {
        let strays = [[0.0; 3], [1e6, 0.0, 0.0]];
        for metric in [Metric::Euclidean, Metric::Chamfer] {
            let options = DistanceOptions {
                metric,
                ..DistanceOptions::default()
            };
            let build = |source: &[Point], target: &[Point]| {
                DistanceTransform::build(source, target, &options, &Uncontrolled).unwrap_err()
            };
            let extent = |error| matches!(error, DistanceError::Extent { .. });
            assert!(extent(build(&strays, &[[0.0; 3]])));
            assert!(extent(build(&[], &strays)));
            assert!(extent(build(&[[f32::MIN; 3]], &[[f32::MAX; 3]])));
            assert!(extent(build(&[], &[[f32::NAN; 3]])));
            assert!(extent(build(&[], &[[f32::INFINITY, 0.0, 0.0]])));
            assert_eq!(build(&[[0.0; 3]], &[]), DistanceError::EmptyTarget);
        }
    }

    #[test]
    fn transforms_that_would_not_fit_are_refused_before_they_are_built() {
        let memory = |source: &[Point], target: &[Point], options: &DistanceOptions| {
            let error =
                DistanceTransform::build(source, target, options, &Uncontrolled).unwrap_err();
            let DistanceError::Memory { needed, limit } = error else {
                return false;
            };
            needed > limit
        };
        // 1e5 cells along every axis: 1e15 in all.
        let corners = [[-5000.0; 3], [5000.0; 3]];
        let dense = DistanceOptions {
            metric: Metric::Chamfer,
            ..DistanceOptions::default()
        };
        assert!(memory(&[], &corners, &dense));
        assert!(memory(&[], &corners, &DistanceOptions::default()));
        // 2e7 cells along every axis: more bytes than 64 bits can count.
        let huge = [[-10_000.0; 3], [10_000.0; 3]];
        for metric in [Metric::Chamfer, Metric::Euclidean] {
            let options = DistanceOptions {
                metric,
                max_bytes: usize::MAX,
                cell_m: 1e-3,
                band_m: 0.02,
                ..DistanceOptions::default()
            };
            assert!(memory(&[], &huge, &options));
        }
        let target = boxed(300, [9.0, 6.0, 3.0]);
        let source = boxed(300, [30.0, 30.0, 9.0]);
        for sites in [Sites::Cells, Sites::Points] {
            let fits = DistanceOptions {
                sites,
                band_m: 6.4,
                ..DistanceOptions::default()
            };
            let bytes = Bricks::build(&source, &target, &fits, &Uncontrolled)
                .unwrap()
                .bytes();
            for max_bytes in [0, 1000, bytes / 2] {
                let options = DistanceOptions {
                    max_bytes,
                    ..fits.clone()
                };
                assert!(memory(&source, &target, &options));
            }
        }
    }

    /// 2,000 columns of 18 km each would take 9 GB along z if empty space were stored.
    #[test]
    fn tall_empty_columns_take_no_memory() {
        let mut target = boxed(2000, [4.0, 4.0, 0.0]);
        let high: Vec<_> = target.iter().map(|p| [p[0], p[1], 18_000.0]).collect();
        target.extend(high);
        let options = DistanceOptions {
            max_bytes: 64 << 20,
            band_m: 0.2,
            ..DistanceOptions::default()
        };
        let bricks = Bricks::build(&[], &target, &options, &Uncontrolled).unwrap();
        assert_eq!(
            bricks.sample(target[0]).distance,
            bricks.sample(target[2000]).distance
        );
        assert!(bricks.bytes() < options.max_bytes);
    }

    #[test]
    fn options_out_of_range_are_refused() {
        let refused = |cell_m: f64, band_m: f64| {
            let options = DistanceOptions {
                cell_m,
                band_m,
                ..DistanceOptions::default()
            };
            DistanceTransform::build(&[], &[[0.0; 3]], &options, &Uncontrolled).err()
        };
        for cell in [0.0, -0.1, 1e-4, f64::NAN, f64::INFINITY] {
            assert!(matches!(
                refused(cell, 2.0),
                Some(DistanceError::Cell { .. })
            ));
        }
        for band in [0.0, -2.0, 0.04, 6.46, 1e300, f64::NAN, f64::INFINITY] {
            assert!(matches!(
                refused(0.1, band),
                Some(DistanceError::Band { .. })
            ));
        }
        assert_eq!(refused(0.1, 0.1), None);
        assert_eq!(refused(0.1, 6.4), None);
    }
}
