//! The distance transform's options and errors; checked before anything is allocated.

/// How distance is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Metric {
    /// Exact Euclidean distance, in bricks.
    Euclidean,
    /// The published code's path metric on a dense grid: up to 12.8% too long.
    Chamfer,
}

/// What distances are measured to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sites {
    /// The vertices nearest to the target's points, as published.
    Cells,
    /// The target's points themselves.
    Points,
}

/// Options of the distance transform.
#[derive(Clone, Debug, PartialEq)]
pub struct DistanceOptions {
    /// How distance is measured.
    pub metric: Metric,
    /// What distances are measured to, by [`Metric::Euclidean`].
    pub sites: Sites,
    /// Edge of a cell, metres. FNSF Section 4: 0.1.
    pub cell_m: f64,
    /// Radius of the band in which distances are exact, metres. At most [`Self::MAX_BAND_CELLS`]
    /// cells.
    pub band_m: f64,
    /// Bytes that the transform may take; more is refused.
    pub max_bytes: usize,
}

impl DistanceOptions {
    /// The band's largest radius in cells: squared sums stay within 16 bits.
    pub const MAX_BAND_CELLS: f64 = 64.0;

    /// The band's radius in whole cells.
    pub(crate) fn band_cells(&self) -> i32 {
        (self.band_m / self.cell_m).round() as i32
    }

    /// Refuses sizes that are not positive and finite, and bands that are too wide.
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

/// Why a distance transform was refused.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum DistanceError {
    /// The cell's edge is unusable.
    #[error("a cell of {cell_m} m is not possible: choose at least 0.001 m")]
    Cell {
        /// The edge asked for.
        cell_m: f64,
    },
    /// The band is empty or too wide.
    #[error("a band of {band_m} m with cells of {cell_m} m is not possible: choose 1 to 64 cells")]
    Band {
        /// The radius asked for.
        band_m: f64,
        /// The cell's edge.
        cell_m: f64,
    },
    /// A cloud has no point.
    #[error("the target cloud is empty")]
    EmptyTarget,
    /// The clouds span too much space.
    #[error(
        "the clouds span {x_m:.0} x {y_m:.0} x {z_m:.0} m, more than {limit_m:.0} m on an axis: \
         remove stray points or crop with a range"
    )]
    Extent {
        /// Extent along x, metres.
        x_m: f64,
        /// Extent along y, metres.
        y_m: f64,
        /// Extent along z, metres.
        z_m: f64,
        /// The longest extent that is taken, metres.
        limit_m: f64,
    },
    /// The transform would not fit.
    #[error("the distance transform needs {needed} bytes, {limit} are allowed: crop with a range")]
    Memory {
        /// Bytes needed.
        needed: usize,
        /// Bytes allowed.
        limit: usize,
    },
}
