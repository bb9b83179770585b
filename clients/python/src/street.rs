//! Simulated streets, with the true motion of every point.

use fnsf::flow::simulate::{StreetOptions, StreetSweep};
use fnsf::formats::matrix_rows;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{from_motion, from_points, from_values, matrix};
use crate::errors::input;
use crate::objects;
use crate::supervision::{Watch, supervised_on_threads};

/// A simulated street.
#[pyclass(frozen, module = "fnsf._native")]
pub(crate) struct Street(fnsf::flow::simulate::Street);

#[pymethods]
impl Street {
    #[new]
    #[pyo3(signature = (*, seed=0, sweeps=2, beams=64, azimuth_steps=2000, movers=24, speed=None, rolling=false))]
    #[expect(
        clippy::too_many_arguments,
        reason = "the arguments of the Python function, named at its only call"
    )]
    fn new(
        seed: u64,
        sweeps: usize,
        beams: usize,
        azimuth_steps: usize,
        movers: usize,
        speed: Option<f64>,
        rolling: bool,
    ) -> PyResult<Self> {
        let options = StreetOptions {
            seed,
            sweeps,
            beams,
            azimuth_steps,
            movers,
            speed_mps: speed,
            rolling,
            ..StreetOptions::default()
        };
        let street = fnsf::flow::simulate::Street::new(&options).map_err(input)?;
        Ok(Self(street))
    }

    /// Number of sweeps.
    fn __len__(&self) -> usize {
        self.0.sweeps()
    }

    /// A sweep: points, times, ground, object, pose.
    fn sweep<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        let watch = Watch::new(None)?;
        let sweep = supervised_on_threads(py, &watch, || self.0.sweep(index))?.map_err(input)?;
        let answer = PyDict::new(py);
        answer.set_item("points", from_points(py, &sweep.points))?;
        let times = sweep.times.as_ref();
        answer.set_item("times", times.map(|times| from_values(py, times)))?;
        answer.set_item("ground", from_values(py, &sweep.ground))?;
        answer.set_item("object", from_values(py, &sweep.object))?;
        let pose = matrix_rows(&sweep.world_from_sensor);
        answer.set_item("pose", matrix(py, pose.as_flattened(), 4))?;
        Ok(answer)
    }

    /// A pair of consecutive sweeps with its truth.
    fn pair<'py>(&self, py: Python<'py>, index: usize) -> PyResult<Bound<'py, PyDict>> {
        let watch = Watch::new(None)?;
        let pair = supervised_on_threads(py, &watch, || self.0.pair(index))?.map_err(input)?;
        let answer = PyDict::new(py);
        answer.set_item("source", from_points(py, &pair.source))?;
        answer.set_item("target", from_points(py, &pair.target))?;
        answer.set_item("flow", from_points(py, &pair.flow))?;
        answer.set_item("valid", from_values(py, &vec![true; pair.flow.len()]))?;
        answer.set_item("dynamic", from_values(py, &pair.dynamic))?;
        answer.set_item("foreground", from_values(py, &pair.foreground))?;
        answer.set_item("category", py.None())?;
        let masks = [&pair.ground_source, &pair.ground_target];
        let masks = masks.map(|mask| from_values(py, mask));
        answer.set_item("masks", masks.into_iter().collect::<Vec<_>>())?;
        answer.set_item("ego", from_motion(py, &pair.target_from_source))?;
        Ok(answer)
    }

    /// The true tracks of the moving objects.
    fn tracks<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let watch = Watch::new(None)?;
        let tracks = supervised_on_threads(py, &watch, || {
            let sweeps = (0..self.0.sweeps()).map(|index| self.0.sweep(index));
            let sweeps: Result<Vec<StreetSweep>, _> = sweeps.collect();
            sweeps.map(|sweeps| self.0.tracks(&sweeps))
        })?;
        objects::tracks(py, &tracks.map_err(input)?)
    }
}
