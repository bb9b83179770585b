//! Argoverse 2's raster of a city's ground heights, and ground masks of sweeps from it.

use nalgebra::Point3;

use super::error::{FileKind, FormatError};
use super::npy::Header;
use crate::flow::{Point, RigidTransform};

/// Largest height of a ground point above the raster, metres; points below the raster are ground at
/// any depth. Argoverse 2's own threshold.
const GROUND_M: f64 = 0.3;

/// Tolerance of the similarity's rotation from orthonormal.
const RIGID_TOLERANCE: f64 = 1e-6;

/// Argoverse 2's raster of a city's ground heights, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundRaster {
    /// Heights in the city's frame, metres, row by row; NaN where unknown.
    heights: Vec<f32>,
    columns: usize,
    raster_from_city: Similarity,
}

/// The similarity from city coordinates to the raster: column and row are s (R x + t).
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize)]
struct Similarity {
    #[serde(rename = "R")]
    rotation: [f64; 4],
    #[serde(rename = "t")]
    translation: [f64; 2],
    #[serde(rename = "s")]
    scale: f64,
}

impl GroundRaster {
    /// Reads a raster from the contents of its two files.
    ///
    /// - `heights` is `*_ground_height_surface____*.npy`: rows x columns floats, metres in the
    ///   city's frame, NaN where unknown.
    /// - `raster_from_city` is `*___img_Sim2_city.json`: the similarity s (R x + t) from city
    ///   coordinates in metres to column and row, with `R` (2 x 2, row by row, as four numbers),
    ///   `t` and `s`.
    ///
    /// # Errors
    /// - `Unsupported` where `heights` is not a two-dimensional array of floats, or of an npy
    ///   version other than 1 to 3.
    /// - `Malformed` where it is not `.npy` or is truncated. Also where `raster_from_city` is not
    ///   such a JSON object, `R` is not orthonormal within 1e-6, or `s` is not positive.
    /// - `TooLarge` where the size of the array overflows.
    pub fn read(heights: &[u8], raster_from_city: &[u8]) -> Result<Self, FormatError> {
        let kind = FileKind::Npy;
        let mut rest = heights;
        let header = Header::read(kind, &mut rest)?;
        let Some((rows, columns)) = header.table().filter(|_| header.scalar.is_float()) else {
            return Err(kind.unsupported(format!(
                "a raster of heights is two-dimensional and of floats, not of shape {:?}",
                header.shape
            )));
        };
        let declared = header.data_len(kind)?;
        if declared > rest.len() as u64 {
            return Err(kind.malformed(format!(
                "a raster of {rows} x {columns} needs {declared} bytes where {} are left",
                rest.len()
            )));
        }
        let mut cells = vec![f32::NAN; rows * columns];
        let order = header.order;
        let fortran = header.fortran;
        header
            .scalar
            .each(order, rows * columns, kind, &mut rest, |index, height| {
                let at = if fortran {
                    index % rows * columns + index / rows
                } else {
                    index
                };
                cells[at] = height as f32;
                Ok(())
            })?;
        Ok(Self {
            heights: cells,
            columns,
            raster_from_city: Similarity::read(raster_from_city)?,
        })
    }

    /// Ground mask of a sweep.
    ///
    /// `points` are N points of the sweep in its own frame, metres. `city_from_frame` is the pose
    /// of the sweep in the city, translation in metres. The result is N flags.
    ///
    /// A point is ground if it is at most 0.3 m above the raster's height, or anywhere below it
    /// (Argoverse 2's own threshold). Points that are not finite, lie outside the raster or where
    /// its height is unknown are not ground.
    pub fn ground(&self, points: &[Point], city_from_frame: &RigidTransform) -> Vec<bool> {
        let is_ground = |point: &Point| {
            let array_path = city_from_frame * Point3::from(point.map(f64::from));
            self.height(array_path.x, array_path.y)
                .is_some_and(|height| array_path.z - height <= GROUND_M)
        };
        points.iter().map(is_ground).collect()
    }

    /// Ground height at city coordinates, metres; `None` where it is unknown.
    fn height(&self, x: f64, y: f64) -> Option<f64> {
        // Fractions are truncated, as in Argoverse 2's own tools.
        let [column, row] = self.raster_from_city.cell(x, y).map(f64::trunc);
        if !(column >= 0.0 && column < self.columns as f64 && row >= 0.0) {
            return None;
        }
        let index = (row as usize).checked_mul(self.columns)? + column as usize;
        let height = f64::from(*self.heights.get(index)?);
        (!height.is_nan()).then_some(height)
    }
}

impl Similarity {
    fn read(bytes: &[u8]) -> Result<Self, FormatError> {
        let kind = FileKind::Json;
        let read: Self =
            serde_json::from_slice(bytes).map_err(|error| kind.malformed(error.to_string()))?;
        let [a, b, c, d] = read.rotation;
        let departure = [a * a + c * c - 1.0, b * b + d * d - 1.0, a * b + c * d];
        let is_rotation = departure.iter().all(|value| value.abs() <= RIGID_TOLERANCE);
        let numbers = read.translation.into_iter().chain([read.scale]);
        if !is_rotation || read.scale <= 0.0 || numbers.into_iter().any(|n| !n.is_finite()) {
            return Err(kind.malformed("R, t and s are no similarity of the plane"));
        }
        Ok(read)
    }

    /// Column and row of city coordinates, with their fractions.
    fn cell(&self, x: f64, y: f64) -> [f64; 2] {
        let [a, b, c, d] = self.rotation;
        let [right, down] = self.translation;
        [
            (a * x + b * y + right) * self.scale,
            (c * x + d * y + down) * self.scale,
        ]
    }
}
