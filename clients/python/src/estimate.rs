//! The estimate of a pair, and the motion field that it leaves.

use std::sync::Arc;

use fnsf::flow::field::{Backend, BackendError};
use fnsf::flow::{
    Estimate, FlowError, Ground, MotionField, Options, Point, Problem, Residual, estimate as solve,
};
use fnsf::formats::{SweepClock, pair_interval_s};
use fnsf::job::{JobOptions, Report};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::arrays::{
    Mask, PointArray, Values, column, from_motion, from_points, from_values, matrix, points,
};
use crate::device::{Opened, cpu, open, warn_of_cpu};
use crate::errors::{flow, input, internal};
use crate::supervision::{Watch, supervised};
use crate::{arrays, errors, objects};

/// The options of estimates, and the device that computes them.
pub(crate) struct Place {
    name: String,
    threads: Option<usize>,
    backend: Opened,
    pub(crate) options: JobOptions,
}

impl Place {
    /// Opens the device `name` for `options`.
    pub(crate) fn open(
        py: Python<'_>,
        name: &str,
        threads: Option<usize>,
        options: JobOptions,
    ) -> PyResult<Self> {
        Ok(Self {
            name: name.to_owned(),
            threads,
            backend: open(py, name, threads, options.runs_on_gpu())?,
            options,
        })
    }

    /// Does `work` on the device. With `auto` it falls back to the CPU where the GPU has too little
    /// memory.
    pub(crate) fn run<T: Send>(
        &mut self,
        py: Python<'_>,
        watch: &Watch,
        told: Option<&Bound<'_, PyAny>>,
        mut work: impl FnMut(&dyn Backend) -> Result<T, FlowError> + Send,
    ) -> PyResult<T> {
        let backend = Arc::clone(&self.backend);
        let done = supervised(py, watch, told, || work(backend.as_ref()))?;
        let done = match done {
            Err(FlowError::Backend(error @ BackendError::Memory { .. })) if self.name == "auto" => {
                warn_of_cpu(py, &error.to_string())?;
                self.backend = cpu(self.threads)?;
                let backend = Arc::clone(&self.backend);
                supervised(py, watch, told, || work(backend.as_ref()))?
            }
            done => done,
        };
        done.map_err(|error| flow(&error))
    }
}

/// Reads options of the JSON object of the service.
pub(crate) fn options_of(json: &str) -> PyResult<JobOptions> {
    JobOptions::from_json(json.as_bytes()).map_err(input)
}

/// Whether an estimate takes ground points as any others. It then ignores masks.
#[pyfunction]
pub(crate) fn keeps_ground(options: &str) -> PyResult<bool> {
    let options = options_of(options)?;
    Ok(options.solver_options(0).ground == Ground::Keep)
}

/// The options of the solver for two clouds.
pub(crate) fn solver_options(options: &JobOptions, [source, target]: [usize; 2]) -> Options {
    options.solver_options(source.max(target))
}

/// A motion field: the motion of any point from the source sweep's time to the target's.
#[pyclass(frozen, module = "fnsf._native")]
pub(crate) struct Motion {
    field: MotionField,
}

#[pymethods]
impl Motion {
    /// The displacements of points in the source's frame, N x 3, metres.
    #[pyo3(signature = (points, device="auto", threads=None))]
    fn __call__<'py>(
        &self,
        py: Python<'py>,
        points: PointArray<'py>,
        device: &str,
        threads: Option<usize>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let points = arrays::points("points", &points)?;
        let is_network = matches!(self.field.residual, Residual::Network(_));
        let backend = open(py, device, threads, is_network)?;
        let watch = Watch::new(None)?;
        let moved = supervised(py, &watch, None, || {
            let fixed = self.field.static_positions(&points);
            let residual = self.field.residual(backend.as_ref(), &fixed)?;
            let moved = points.iter().zip(&fixed).zip(&residual);
            let flow = |((point, fixed), residual): ((&Point, &Point), &Point)| {
                core::array::from_fn(|axis| fixed[axis] - point[axis] + residual[axis])
            };
            Ok::<Vec<Point>, BackendError>(moved.map(flow).collect())
        })?;
        let moved = moved.map_err(|error| errors::device(&error))?;
        Ok(from_points(py, &moved).into_any())
    }

    /// The motion as bytes, which `from_bytes` reads.
    fn to_bytes<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.field.to_bytes())
    }

    /// Reads the bytes of `to_bytes`.
    #[staticmethod]
    fn from_bytes(bytes: &[u8]) -> PyResult<Self> {
        let field = MotionField::from_bytes(bytes).map_err(input)?;
        Ok(Self { field })
    }

    fn __reduce__<'py>(
        slf: &Bound<'py, Self>,
    ) -> PyResult<(Bound<'py, PyAny>, (Bound<'py, PyBytes>,))> {
        let read = slf.get_type().getattr("from_bytes")?;
        Ok((read, (slf.get().to_bytes(slf.py()),)))
    }
}

/// An estimate as a dictionary of arrays, its report as JSON, and its motion field. `sweeps` are the
/// source and the target as they were given.
pub(crate) fn answer<'py>(
    py: Python<'py>,
    estimate: Estimate,
    options: &JobOptions,
    sweeps: [&Arc<[Point]>; 2],
) -> PyResult<Bound<'py, PyDict>> {
    let [source, _] = estimate.sweeps(sweeps);
    let report = serde_json::to_string(&Report::new(&estimate, options)).map_err(internal)?;
    let answer = PyDict::new(py);
    answer.set_item("source", from_points(py, &source))?;
    answer.set_item("flow", from_points(py, &estimate.flow))?;
    answer.set_item("valid", from_values(py, &estimate.valid))?;
    let dynamic = estimate.dynamic.as_ref();
    answer.set_item("dynamic", dynamic.map(|dynamic| from_values(py, dynamic)))?;
    let ego = estimate.ego.as_ref();
    answer.set_item("ego", ego.map(|ego| from_motion(py, ego)))?;
    let covariance = estimate.ego_covariance.as_ref();
    // The matrix is symmetric, so its columns are its rows.
    let covariance = covariance.map(|covariance| matrix(py, covariance.as_slice(), 6));
    answer.set_item("ego_covariance", covariance)?;
    let objects = estimate.objects();
    let list = |values: fn(&fnsf::flow::Objects) -> &Vec<f32>| {
        objects.map(|objects| from_values(py, values(objects)))
    };
    answer.set_item("confidence", list(|objects| &objects.confidence))?;
    answer.set_item("moving", list(|objects| &objects.moving))?;
    let cluster = objects.map(|objects| from_values(py, &objects.cluster));
    answer.set_item("cluster", cluster)?;
    let clusters = objects.map(|objects| objects::clusters(py, &objects.clusters));
    answer.set_item("clusters", clusters.transpose()?)?;
    answer.set_item("report", report)?;
    let field = estimate.motion;
    answer.set_item("motion", Py::new(py, Motion { field })?)?;
    Ok(answer)
}

/// The clock of a sweep whose points have times. Points that are not finite count for nothing.
pub(crate) fn clock_of(points: &[Point], times: &[f32]) -> SweepClock {
    let measured = points.iter().zip(times);
    let measured = measured.filter(|(point, _)| point.iter().all(|c| c.is_finite()));
    let ends = measured.fold(
        [f32::INFINITY, f32::NEG_INFINITY],
        |[first, last], (_, &time)| [first.min(time), last.max(time)],
    );
    SweepClock {
        duration_s: f64::from(ends[1]) - f64::from(ends[0]),
        sweep_s: None,
    }
}

/// Seconds from one sweep to another by their names and, where points have times, by their duration
/// and the time on the sensor's clock. Below zero where the other was measured first; none where
/// nothing is known.
#[pyfunction]
pub(crate) fn pair_interval(
    names: [String; 2],
    clocks: [Option<(f64, Option<f64>)>; 2],
) -> Option<f32> {
    let clocks = clocks.map(|clock| {
        clock.map(|(duration_s, sweep_s)| SweepClock {
            duration_s,
            sweep_s,
        })
    });
    pair_interval_s([&names[0], &names[1]], clocks)
}

/// Refuses what an estimate would refuse of its options, its deadline and its device. The device is
/// open then.
#[pyfunction]
#[pyo3(signature = (options, *, deadline=None, device="auto", threads=None))]
pub(crate) fn check_options(
    py: Python<'_>,
    options: &str,
    deadline: Option<f64>,
    device: &str,
    threads: Option<usize>,
) -> PyResult<()> {
    Watch::new(deadline)?;
    Place::open(py, device, threads, options_of(options)?).map(drop)
}

/// Estimates the motion of every point of `source`, N x 3 metres, to `target`, M x 3 metres.
///
/// `options` is the JSON object of the service. `masks` and `times` have one row for each point of
/// the two sweeps. `progress` is called with done, total and loss.
#[pyfunction]
#[pyo3(signature = (source, target, options, *, masks=None, times=None, deadline=None, device="auto", threads=None, progress=None))]
#[expect(
    clippy::too_many_arguments,
    reason = "the arguments of the Python function, named at its only call"
)]
pub(crate) fn estimate<'py>(
    py: Python<'py>,
    source: PointArray<'py>,
    target: PointArray<'py>,
    options: &str,
    masks: Option<(Mask<'py>, Mask<'py>)>,
    times: Option<(Values<'py>, Values<'py>)>,
    deadline: Option<f64>,
    device: &str,
    threads: Option<usize>,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let watch = Watch::new(deadline)?;
    let mut options = options_of(options)?;
    let source: Arc<[Point]> = points("pc1", &source)?.into();
    let target: Arc<[Point]> = points("pc2", &target)?.into();
    let counts = [source.len(), target.len()];
    let masks = masks.map(|(first, second)| {
        let second = column("the ground mask of pc2", &second, counts[1])?;
        Ok::<_, PyErr>([column("the ground mask of pc1", &first, counts[0])?, second])
    });
    let masks = masks.transpose()?;
    let times = times.map(|(first, second)| {
        let second = column("the times of pc2", &second, counts[1])?;
        Ok::<_, PyErr>([column("the times of pc1", &first, counts[0])?, second])
    });
    let times = times.transpose()?;
    if let (None, Some(times)) = (options.dt_s, &times) {
        let clocks = [clock_of(&source, &times[0]), clock_of(&target, &times[1])];
        options.dt_s = pair_interval_s(["", ""], clocks.map(Some));
    }
    let mut problem = Problem::pair(&source, &target);
    problem.ground = masks.as_ref().map(|of| [of[0].as_slice(), &of[1]]);
    problem.times = times.as_ref().map(|of| [of[0].as_slice(), &of[1]]);
    let solver = solver_options(&options, counts);
    let mut place = Place::open(py, device, threads, options)?;
    let estimate = place.run(py, &watch, progress.as_ref(), |backend| {
        solve(backend, &problem, &solver, &watch)
    })?;
    answer(py, estimate, &place.options, [&source, &target])
}
