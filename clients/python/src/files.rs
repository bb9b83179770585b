//! Files, as bytes: sweeps, pairs and flows in all formats of the library.

use fnsf::flow::{Objects, RigidTransform};
use fnsf::formats::{self, CloudFormat, FlowFormat, FlowTable};
use fnsf::picture::{self, TopDown, TopDownOptions};
use numpy::PyReadonlyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::arrays::{
    Mask, Matrix, PointArray, Values, column, from_motion, from_points, from_values, motion, points,
};
use crate::errors::{input, internal};
use crate::objects;
use crate::supervision::{Watch, supervised, supervised_on_threads};

/// Reads a sweep: its points, and the times of its points where the file has them.
#[pyfunction]
pub(crate) fn read_sweep<'py>(
    py: Python<'py>,
    bytes: &[u8],
    name: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let watch = Watch::new(None)?;
    let read = supervised(py, &watch, None, || {
        formats::read_timed_cloud(bytes, Some(name))
    })?;
    let read = read.map_err(|error| input(format!("{name}: {error}")))?;
    let answer = PyDict::new(py);
    answer.set_item("points", from_points(py, &read.cloud.points))?;
    let times = read.times.as_ref();
    let offsets = times.map(|times| from_values(py, &times.offsets_s));
    answer.set_item("times", offsets)?;
    answer.set_item("time", read.clock.and_then(|clock| clock.sweep_s))?;
    answer.set_item("duration", read.clock.map(|clock| clock.duration_s))?;
    answer.set_item("refused_times", &read.refused_times)?;
    Ok(answer)
}

/// Reads a pair of sweeps with what is known of its truth.
#[pyfunction]
pub(crate) fn read_pair<'py>(
    py: Python<'py>,
    bytes: &[u8],
    name: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let watch = Watch::new(None)?;
    let pair = supervised(py, &watch, None, || formats::read_pair(bytes))?;
    let pair = pair.map_err(|error| input(format!("{name}: {error}")))?;
    let answer = PyDict::new(py);
    answer.set_item("source", from_points(py, &pair.source))?;
    answer.set_item("target", from_points(py, &pair.target))?;
    let truth = pair.truth.as_ref();
    answer.set_item("flow", truth.map(|truth| from_points(py, &truth.flow)))?;
    answer.set_item("valid", truth.map(|truth| from_values(py, &truth.valid)))?;
    let flags = |flags: Option<&Vec<bool>>| flags.map(|flags| from_values(py, flags));
    let dynamic = truth.and_then(|truth| truth.dynamic.as_ref());
    answer.set_item("dynamic", flags(dynamic))?;
    let foreground = truth.and_then(|truth| truth.foreground.as_ref());
    answer.set_item("foreground", flags(foreground))?;
    let category = truth.and_then(|truth| truth.category.as_ref());
    answer.set_item("category", category.map(|ids| from_values(py, ids)))?;
    let masks = pair.ground.as_ref();
    let masks = masks.map(|masks| {
        let both = [&masks.source, &masks.target];
        both.map(|mask| from_values(py, mask))
            .into_iter()
            .collect::<Vec<_>>()
    });
    answer.set_item("masks", masks)?;
    answer.set_item("ego", pair.ego.as_ref().map(|ego| from_motion(py, ego)))?;
    Ok(answer)
}

/// Reads a flow.
#[pyfunction]
pub(crate) fn read_flow<'py>(
    py: Python<'py>,
    bytes: &[u8],
    name: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let watch = Watch::new(None)?;
    let file = supervised(py, &watch, None, || formats::read_flow(bytes, Some(name)))?;
    let file = file.map_err(|error| input(format!("{name}: {error}")))?;
    let answer = PyDict::new(py);
    answer.set_item("flow", from_points(py, &file.flow))?;
    let valid = file.valid.unwrap_or_else(|| vec![true; file.flow.len()]);
    answer.set_item("valid", from_values(py, &valid))?;
    let dynamic = file.dynamic.as_ref();
    answer.set_item("dynamic", dynamic.map(|flags| from_values(py, flags)))?;
    let cluster = file.cluster.as_ref();
    answer.set_item("cluster", cluster.map(|ids| from_values(py, ids)))?;
    let values = |values: Option<&Vec<f32>>| values.map(|values| from_values(py, values));
    answer.set_item("confidence", values(file.confidence.as_ref()))?;
    answer.set_item("moving", values(file.moving.as_ref()))?;
    let clusters = file.clusters.as_ref();
    let clusters = clusters.map(|clusters| objects::clusters(py, clusters));
    answer.set_item("clusters", clusters.transpose()?)?;
    answer.set_item("ego", file.ego.as_ref().map(|ego| from_motion(py, ego)))?;
    Ok(answer)
}

/// The columns of a flow: source, flow, valid, dynamic, ego.
type FlowArrays<'py> = (
    PointArray<'py>,
    PointArray<'py>,
    Mask<'py>,
    Option<Mask<'py>>,
    Option<Matrix<'py>>,
);
/// The columns of its objects: cluster, confidence, moving, and the bytes of the clusters.
type ObjectArrays<'py> = (
    PyReadonlyArray1<'py, i32>,
    Values<'py>,
    Values<'py>,
    Vec<u8>,
);

/// A flow as the bytes of a file. The ending of `name` gives the format.
#[pyfunction]
#[pyo3(signature = (name, flow, objects=None))]
pub(crate) fn write_flow<'py>(
    py: Python<'py>,
    name: &str,
    flow: FlowArrays<'py>,
    objects: Option<ObjectArrays<'py>>,
) -> PyResult<Bound<'py, PyBytes>> {
    let format = FlowFormat::from_path(name.as_ref()).map_err(input)?;
    let (source, displacements, valid, dynamic, ego) = flow;
    let source = points("source", &source)?;
    let rows = source.len();
    let displacements = points("flow", &displacements)?;
    let valid = column("valid", &valid, rows)?;
    let dynamic = dynamic.map(|dynamic| column("dynamic", &dynamic, rows));
    let dynamic = dynamic.transpose()?;
    let ego: Option<RigidTransform> = ego.map(|ego| motion("ego", &ego)).transpose()?;
    let objects = objects.map(|(cluster, confidence, moving, clusters)| {
        Ok::<_, PyErr>(Objects {
            cluster: column("cluster", &cluster, rows)?,
            confidence: column("confidence", &confidence, rows)?,
            moving: column("moving", &moving, rows)?,
            clusters: objects::clusters_of(&clusters)?,
        })
    });
    let objects = objects.transpose()?;
    let watch = Watch::new(None)?;
    let written = supervised(py, &watch, None, || {
        let table = FlowTable {
            source: &source,
            flow: &displacements,
            valid: &valid,
            dynamic: dynamic.as_deref(),
            objects: objects.as_ref(),
            ego: ego.as_ref(),
        };
        let mut bytes = Vec::new();
        formats::write_flow(format, &table, &mut bytes).map(|()| bytes)
    })?;
    Ok(PyBytes::new(py, &written.map_err(input)?))
}

/// A picture of a flow from above, as the bytes of a PNG file.
#[pyfunction]
#[pyo3(name = "picture", signature = (flow, clusters=None))]
pub(crate) fn draw<'py>(
    py: Python<'py>,
    flow: FlowArrays<'py>,
    clusters: Option<Vec<u8>>,
) -> PyResult<Bound<'py, PyBytes>> {
    let (source, displacements, valid, _, ego) = flow;
    let source = points("source", &source)?;
    let displacements = points("flow", &displacements)?;
    let valid = column("valid", &valid, source.len())?;
    if displacements.len() != source.len() {
        return Err(input("flow and source differ in length"));
    }
    let ego: Option<RigidTransform> = ego.map(|ego| motion("ego", &ego)).transpose()?;
    let clusters = objects::clusters_of(&clusters.unwrap_or_default())?;
    let watch = Watch::new(None)?;
    let drawn = supervised_on_threads(py, &watch, || {
        let from_above = TopDown {
            source: &source,
            flow: &displacements,
            valid: &valid,
            ego: ego.as_ref(),
            clusters: &clusters,
        };
        let image = picture::top_down(&from_above, &TopDownOptions::default());
        let mut bytes = Vec::new();
        picture::write_png(&image, &mut bytes).map(|()| bytes)
    })?;
    Ok(PyBytes::new(py, &drawn.map_err(internal)?))
}

/// A sweep, N x 3 metres, as the bytes of a file. The ending of `name` gives the format.
#[pyfunction]
pub(crate) fn write_points<'py>(
    py: Python<'py>,
    name: &str,
    sweep: PointArray<'py>,
) -> PyResult<Bound<'py, PyBytes>> {
    let ending = name.rsplit('.').next().unwrap_or_default();
    let format = match ending.to_ascii_lowercase().as_str() {
        "npy" => CloudFormat::Npy,
        "ply" => CloudFormat::Ply,
        "pcd" => CloudFormat::Pcd,
        "feather" => CloudFormat::Feather,
        "bin" => CloudFormat::KittiBin,
        _ => {
            return Err(input(format!(
                "{name}: a sweep is written as .npy, .ply, .pcd, .feather or .bin"
            )));
        }
    };
    let points = points("points", &sweep)?;
    let watch = Watch::new(None)?;
    let written = supervised(py, &watch, None, || {
        let mut bytes = Vec::new();
        formats::write_cloud(format, &points, &mut bytes).map(|()| bytes)
    })?;
    Ok(PyBytes::new(py, &written.map_err(input)?))
}
