//! Clusters and tracks as numpy structured arrays.

use bytemuck::{Pod, Zeroable};
use fnsf::flow::tracks::Track;
use fnsf::flow::{Cluster, OrientedBox, Point};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::errors::input;

/// A row of the array of clusters, laid out as numpy aligns its fields.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct ClusterRow {
    points: u32,
    dynamic: u8,
    padding: [u8; 3],
    center: Point,
    size: Point,
    yaw: f32,
    velocity: Point,
    yaw_rate: f32,
    confidence: f32,
    moving: f32,
}

/// A row of the array of tracks: one object in one sweep.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct StateRow {
    id: u32,
    sweep: u32,
    points: u32,
    center: Point,
    size: Point,
    yaw: f32,
    velocity: Point,
    yaw_rate: f32,
    confidence: f32,
}

/// A field of a structured array: its name, its type, and its number of values.
type Field = (&'static str, &'static str, usize);

const CLUSTER: [Field; 9] = [
    ("points", "u4", 1),
    ("dynamic", "?", 1),
    ("center", "f4", 3),
    ("size", "f4", 3),
    ("yaw", "f4", 1),
    ("velocity", "f4", 3),
    ("yaw_rate", "f4", 1),
    ("confidence", "f4", 1),
    ("moving", "f4", 1),
];
const STATE: [Field; 9] = [
    ("id", "u4", 1),
    ("sweep", "u4", 1),
    ("points", "u4", 1),
    ("center", "f4", 3),
    ("size", "f4", 3),
    ("yaw", "f4", 1),
    ("velocity", "f4", 3),
    ("yaw_rate", "f4", 1),
    ("confidence", "f4", 1),
];

/// The type of a structured array with these fields.
fn dtype<'py>(py: Python<'py>, fields: &[Field]) -> PyResult<Bound<'py, PyAny>> {
    let numpy = py.import("numpy")?;
    let fields: Vec<Bound<'py, PyAny>> = fields
        .iter()
        .map(|&(name, of, values)| match values {
            1 => Ok((name, of).into_pyobject(py)?.into_any()),
            _ => Ok((name, of, (values,)).into_pyobject(py)?.into_any()),
        })
        .collect::<PyResult<_>>()?;
    let aligned = PyDict::new(py);
    aligned.set_item("align", true)?;
    numpy.call_method("dtype", (fields,), Some(&aligned))
}

/// An array of `rows` with the fields named. The array is writable and owns its memory.
fn structured<'py>(
    py: Python<'py>,
    fields: &[Field],
    rows: &[impl Pod],
) -> PyResult<Bound<'py, PyAny>> {
    let bytes = PyBytes::new(py, bytemuck::cast_slice(rows));
    py.import("numpy")?
        .call_method1("frombuffer", (bytes, dtype(py, fields)?))?
        .call_method0("copy")
}

/// The types of the arrays of clusters and of tracks.
#[pyfunction]
pub(crate) fn object_types(py: Python<'_>) -> PyResult<(Bound<'_, PyAny>, Bound<'_, PyAny>)> {
    Ok((dtype(py, &CLUSTER)?, dtype(py, &STATE)?))
}

/// K clusters.
pub(crate) fn clusters<'py>(py: Python<'py>, clusters: &[Cluster]) -> PyResult<Bound<'py, PyAny>> {
    let rows: Vec<ClusterRow> = clusters
        .iter()
        .map(|cluster| ClusterRow {
            points: cluster.points,
            dynamic: cluster.dynamic.into(),
            padding: [0; 3],
            center: cluster.bounds.center,
            size: cluster.bounds.size,
            yaw: cluster.bounds.yaw,
            velocity: cluster.velocity,
            yaw_rate: cluster.yaw_rate,
            confidence: cluster.confidence,
            moving: cluster.moving,
        })
        .collect();
    structured(py, &CLUSTER, &rows)
}

/// One row for each state of each track, track by track.
pub(crate) fn tracks<'py>(py: Python<'py>, tracks: &[Track]) -> PyResult<Bound<'py, PyAny>> {
    let states = tracks
        .iter()
        .flat_map(|track| track.states.iter().map(move |state| (track.id, state)));
    let rows: Vec<StateRow> = states
        .map(|(id, state)| StateRow {
            id,
            sweep: state.sweep,
            points: state.points,
            center: state.bounds.center,
            size: state.bounds.size,
            yaw: state.bounds.yaw,
            velocity: state.velocity,
            yaw_rate: state.yaw_rate,
            confidence: state.confidence,
        })
        .collect();
    structured(py, &STATE, &rows)
}

/// The clusters of the bytes of an array as [`clusters`] makes it.
///
/// # Errors
/// `InputError` for bytes of another layout.
pub(crate) fn clusters_of(bytes: &[u8]) -> PyResult<Vec<Cluster>> {
    const ROW: usize = size_of::<ClusterRow>();
    if !bytes.len().is_multiple_of(ROW) {
        return Err(input("clusters is not an array as a Flow has it"));
    }
    let rows = bytes.chunks_exact(ROW).map(bytemuck::pod_read_unaligned);
    let cluster = |row: ClusterRow| Cluster {
        points: row.points,
        dynamic: row.dynamic != 0,
        bounds: OrientedBox {
            center: row.center,
            size: row.size,
            yaw: row.yaw,
        },
        velocity: row.velocity,
        yaw_rate: row.yaw_rate,
        confidence: row.confidence,
        moving: row.moving,
    };
    Ok(rows.map(cluster).collect())
}
