//! numpy arrays as the library's points, masks and matrices, and back.

use fnsf::flow::{Point, RigidTransform};
use fnsf::formats::{MAX_COORDINATE_M, ego_motion, matrix_rows};
use numpy::{
    Element, PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;

use crate::errors::input;

/// N x 3 float32, C-contiguous.
pub(crate) type PointArray<'py> = PyReadonlyArray2<'py, f32>;
/// N flags.
pub(crate) type Mask<'py> = PyReadonlyArray1<'py, bool>;
/// N float32.
pub(crate) type Values<'py> = PyReadonlyArray1<'py, f32>;
/// 4 x 4 float64.
pub(crate) type Matrix<'py> = PyReadonlyArray2<'py, f64>;

/// The points of an array, metres. A row of three NaN is a beam without return.
///
/// # Errors
/// `InputError` for another shape, and for a coordinate that is infinite, NaN beside numbers, or
/// over 1e6 m in magnitude, with row and column.
pub(crate) fn points(name: &str, array: &PointArray<'_>) -> PyResult<Vec<Point>> {
    if array.shape()[1] != 3 {
        let shape = array.shape();
        return Err(input(format!(
            "{name} has shape {shape:?}: N x 3 is needed"
        )));
    }
    let values = array.as_slice().map_err(input)?;
    let points: &[Point] = bytemuck::cast_slice(values);
    for (row, point) in points.iter().enumerate() {
        if point.iter().all(|value| value.is_nan()) {
            continue;
        }
        for (axis, &value) in ["x", "y", "z"].iter().zip(point) {
            if !value.is_finite() {
                return Err(input(format!(
                    "{name} has {value} in row {row}, column {axis}: numbers are needed, or NaN in \
                     all three for a beam without return"
                )));
            }
            if f64::from(value).abs() > MAX_COORDINATE_M {
                return Err(input(format!(
                    "{name} has {value} in row {row}, column {axis}: coordinates are metres in the \
                     sensor's frame, at most 1e6"
                )));
            }
        }
    }
    Ok(points.to_vec())
}

/// The values of an array with one row for each of `rows` points.
pub(crate) fn column<T: Element + Copy>(
    name: &str,
    array: &PyReadonlyArray1<'_, T>,
    rows: usize,
) -> PyResult<Vec<T>> {
    let values = array.as_slice().map_err(input)?;
    if values.len() != rows {
        let found = values.len();
        return Err(input(format!("{name} has {found} rows for {rows} points")));
    }
    Ok(values.to_vec())
}

/// A rigid motion of a 4 x 4 matrix.
pub(crate) fn motion(name: &str, array: &Matrix<'_>) -> PyResult<RigidTransform> {
    if array.shape() != [4, 4] {
        let shape = array.shape();
        return Err(input(format!(
            "{name} has shape {shape:?}: 4 x 4 is needed"
        )));
    }
    let values = array.as_slice().map_err(input)?;
    let rows = core::array::from_fn(|row| core::array::from_fn(|column| values[4 * row + column]));
    ego_motion(&rows).map_err(|error| input(format!("{name}: {error}")))
}

/// N x 3 float32 of points.
pub(crate) fn from_points<'py>(py: Python<'py>, points: &[Point]) -> Bound<'py, PyArray2<f32>> {
    matrix(py, bytemuck::cast_slice(points), 3)
}

/// N values.
pub(crate) fn from_values<'py, T: Element + Copy>(
    py: Python<'py>,
    values: &[T],
) -> Bound<'py, PyArray1<T>> {
    PyArray1::from_slice(py, values)
}

/// 4 x 4 float64 of a rigid motion.
pub(crate) fn from_motion<'py>(
    py: Python<'py>,
    motion: &RigidTransform,
) -> Bound<'py, PyArray2<f64>> {
    matrix(py, matrix_rows(motion).as_flattened(), 4)
}

/// A matrix of `columns` columns, row by row.
pub(crate) fn matrix<'py, T: Element + Copy>(
    py: Python<'py>,
    values: &[T],
    columns: usize,
) -> Bound<'py, PyArray2<T>> {
    let rows = values.len() / columns;
    let array = PyArray1::from_slice(py, values);
    array
        .reshape([rows, columns])
        .expect("the number of values is a multiple of the columns")
}
