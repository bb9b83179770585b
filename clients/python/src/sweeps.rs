//! Ground segmentation and registration.

use fnsf::flow::RigidTransform;
use fnsf::flow::ground::{GroundOptions, segment};
use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;

use crate::arrays::{Matrix, PointArray, from_motion, from_values, matrix, motion, points};
use crate::device::cpu;
use crate::supervision::{Watch, supervised, supervised_on_threads};

/// The flags of the ground points of a sweep, N x 3 metres. Rows of NaN are no ground.
#[pyfunction]
pub(crate) fn ground<'py>(
    py: Python<'py>,
    sweep: PointArray<'py>,
) -> PyResult<Bound<'py, PyArray1<bool>>> {
    let points = points("points", &sweep)?;
    let watch = Watch::new(None)?;
    let mask = supervised_on_threads(py, &watch, || {
        let rows: Vec<usize> = (0..points.len())
            .filter(|&row| !points[row][0].is_nan())
            .collect();
        let finite: Vec<_> = rows.iter().map(|&row| points[row]).collect();
        let found = segment(&finite, &GroundOptions::default()).ground;
        let mut mask = vec![false; points.len()];
        for (row, is_ground) in rows.into_iter().zip(found) {
            mask[row] = is_ground;
        }
        mask
    })?;
    Ok(from_values(py, &mask))
}

/// A motion, 4 x 4, and its covariance, 6 x 6.
type Registered<'py> = (Bound<'py, PyArray2<f64>>, Option<Bound<'py, PyArray2<f64>>>);

/// The ego motion target_from_source, searched around `prior`, with its covariance.
#[pyfunction]
#[pyo3(signature = (source, target, prior=None, threads=None))]
pub(crate) fn register<'py>(
    py: Python<'py>,
    source: PointArray<'py>,
    target: PointArray<'py>,
    prior: Option<Matrix<'py>>,
    threads: Option<usize>,
) -> PyResult<Registered<'py>> {
    let source = points("source", &source)?;
    let target = points("target", &target)?;
    let prior = prior.map_or_else(
        || Ok(RigidTransform::identity()),
        |prior| motion("prior", &prior),
    )?;
    let backend = cpu(threads)?;
    let watch = Watch::new(None)?;
    let found = supervised(py, &watch, None, || {
        backend.host().align(&source, &target, &prior, &watch)
    })?;
    // The matrix is symmetric, so its columns are its rows.
    let covariance = found
        .covariance
        .map(|covariance| matrix(py, covariance.as_slice(), 6));
    Ok((from_motion(py, &found.motion), covariance))
}
