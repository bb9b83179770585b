//! Densification: the sweeps of a sequence as one dense cloud.

use std::collections::BTreeMap;

use fnsf::flow::densify::{self as dense, FieldStep, FlowEdge, estimate_fields};
use fnsf::flow::{DenseCloud, FlowError, MotionField, RigidTransform, Sweep};
use fnsf::formats::{self, DenseFormat};
use numpy::PyReadonlyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::arrays::{Mask, Matrix, PointArray, Values, column, from_points, from_values, points};
use crate::errors::{input, internal};
use crate::estimate::{Place, options_of, solver_options};
use crate::supervision::{Watch, supervised, supervised_on_threads};

/// The motion fields of the plan. `points` are the numbers of points of the sweeps before they were cropped.
fn fields(
    py: Python<'_>,
    place: &mut Place,
    plan: &dense::Plan,
    (sweeps, points): (&[Sweep], &[usize]),
    poses: Option<&[RigidTransform]>,
    told: Option<&Bound<'_, PyAny>>,
) -> PyResult<BTreeMap<FlowEdge, MotionField>> {
    let options = place.options.clone();
    let watch = Watch::new(None)?;
    let pairs = plan.edges().len();
    estimate_fields(plan, |sequence, step| match step {
        FieldStep::Push {
            before,
            index,
            done,
        } => {
            if let Some(told) = told {
                told.call1((done, pairs, py.None()))?;
            }
            let counts = [before, index].map(|sweep| points[sweep]);
            let mut solver = solver_options(&options, counts);
            let poses = poses.map(|poses| [poses[before], poses[index]]);
            solver.ego = solver.ego.of_pair(poses, before > index);
            place.run(py, &watch, None, |backend| {
                sequence.push(backend, sweeps[index].clone(), &solver, &watch)
            })
        }
        FieldStep::Finish => {
            place.run(py, &watch, None, |backend| sequence.finish(backend, &watch))
        }
    })
}

/// A sweep: its points, its ground mask.
type SweepArrays<'py> = (PointArray<'py>, Option<Mask<'py>>);

/// Moves the points of all sweeps to the reference time of `options.densify`.
#[pyfunction]
#[pyo3(signature = (sweeps, options, *, poses=None, device="auto", threads=None, progress=None))]
#[expect(
    clippy::too_many_arguments,
    reason = "the arguments of the Python function, named at its only call"
)]
pub(crate) fn densify<'py>(
    py: Python<'py>,
    sweeps: Vec<SweepArrays<'py>>,
    options: &str,
    poses: Option<Vec<Matrix<'py>>>,
    device: &str,
    threads: Option<usize>,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let options = options_of(options)?;
    let asked = options
        .densify
        .ok_or_else(|| input("densify needs a reference_time"))?;
    let plan = asked.plan(sweeps.len()).map_err(input)?;
    options.check_for_sequence(sweeps.len()).map_err(input)?;
    if poses.is_some() {
        options.check_for_poses().map_err(input)?;
    }
    let poses = poses.map(|poses| {
        if poses.len() != sweeps.len() {
            let (poses, sweeps) = (poses.len(), sweeps.len());
            return Err(input(format!("{poses} poses for {sweeps} sweeps")));
        }
        let poses = poses.iter().map(pose);
        poses.collect::<PyResult<Vec<RigidTransform>>>()
    });
    let poses = poses.transpose()?;
    let solver = options.solver_options(usize::MAX);
    let taken = sweeps.iter().enumerate().map(|(index, (cloud, mask))| {
        let points = points(&format!("sweep {index}"), cloud)?;
        let mask = mask.as_ref();
        let mask = mask.map(|mask| column("the ground mask", mask, points.len()));
        Ok(Sweep {
            ground: mask.transpose()?,
            points,
            ..Sweep::default()
        })
    });
    let taken: Vec<Sweep> = taken.collect::<PyResult<_>>()?;
    let counts: Vec<usize> = taken.iter().map(|sweep| sweep.points.len()).collect();
    let watch = Watch::new(None)?;
    let taken: Vec<Sweep> = supervised_on_threads(py, &watch, || {
        let prepared = taken.into_iter().map(|sweep| sweep.prepared(&solver));
        prepared.map(|sweep| sweep.cropped(&solver)).collect()
    })?;
    let mut place = Place::open(py, device, threads, options)?;
    let told = progress.as_ref();
    let of_sweeps = (taken.as_slice(), counts.as_slice());
    let fields = fields(py, &mut place, &plan, of_sweeps, poses.as_deref(), told)?;
    let watch = Watch::new(None)?;
    let cloud = place.run(py, &watch, None, |backend| {
        let field = |edge: FlowEdge| fields.get(&edge);
        dense::densify(backend, &plan, &taken, field, &watch).map_err(|error| match error {
            dense::DensifyError::Backend(error) => FlowError::from(error),
            dense::DensifyError::Interrupted(_) => FlowError::Cancelled,
            error => unreachable!("the plan, its sweeps and its fields fit together: {error}"),
        })
    })?;
    let answer = PyDict::new(py);
    answer.set_item("points", from_points(py, &cloud.points))?;
    answer.set_item("sweep", from_values(py, &cloud.sweep))?;
    answer.set_item("age", from_values(py, &cloud.age))?;
    answer.set_item("dynamic", from_values(py, &cloud.dynamic))?;
    answer.set_item("converged", from_values(py, &cloud.converged))?;
    Ok(answer)
}

/// A pose, world_from_sensor: its translation may be that of a city.
fn pose(array: &Matrix<'_>) -> PyResult<RigidTransform> {
    let values = array.as_slice().map_err(input)?;
    let rows: [[f64; 4]; 4] = bytemuck::try_cast_slice(values)
        .ok()
        .and_then(|rows: &[[f64; 4]]| rows.try_into().ok())
        .ok_or_else(|| input("a pose is a 4 x 4 matrix"))?;
    formats::rigid_motion(&rows).map_err(|error| input(format!("a pose: {error}")))
}

/// The columns of a dense cloud: points, sweep, age, dynamic, converged.
type DenseArrays<'py> = (
    PointArray<'py>,
    PyReadonlyArray1<'py, u32>,
    Values<'py>,
    Mask<'py>,
    Mask<'py>,
);

/// A dense cloud as the bytes of a file. The ending of `name` gives the format.
#[pyfunction]
pub(crate) fn write_dense<'py>(
    py: Python<'py>,
    name: &str,
    cloud: DenseArrays<'py>,
) -> PyResult<Bound<'py, PyBytes>> {
    let format = DenseFormat::from_path(name.as_ref()).map_err(input)?;
    let (positions, sweep, age, dynamic, converged) = cloud;
    let points = points("points", &positions)?;
    let rows = points.len();
    let cloud = DenseCloud {
        sweep: column("sweep", &sweep, rows)?,
        age: column("age", &age, rows)?,
        dynamic: column("dynamic", &dynamic, rows)?,
        converged: column("converged", &converged, rows)?,
        points,
    };
    let watch = Watch::new(None)?;
    let written = supervised(py, &watch, None, || {
        let mut bytes = Vec::new();
        formats::write_dense(format, &cloud, None, &mut bytes).map(|()| bytes)
    })?;
    Ok(PyBytes::new(py, &written.map_err(internal)?))
}
