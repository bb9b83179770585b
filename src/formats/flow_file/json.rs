//! Flow as one JSON object: `flow` [[x, y, z], ...] in metres, `valid`, and where known `dynamic`,
//! `ego`, `cluster`, `confidence`, `moving` and `clusters`.
//!
//! Other keys are ignored when reading, so that an answer of the service can be read back.

use std::io::Write;

use super::objects::Described;
use super::table::{FlowFile, FlowTable};
use crate::flow::{Cluster, Point};
use crate::formats::error::{FileKind, FormatError};
use crate::formats::limits::{check_probability, check_value};
use crate::formats::motion::{ego_motion, matrix_rows};

const KIND: FileKind = FileKind::Json;

#[derive(serde::Serialize)]
struct Written<'a> {
    flow: &'a [Point],
    valid: &'a [bool],
    #[serde(skip_serializing_if = "Option::is_none")]
    dynamic: Option<&'a [bool]>,
    /// 4 x 4, row by row; null where the ego motion is unknown.
    ego: Option<[[f64; 4]; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cluster: Option<&'a [i32]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    confidence: Option<&'a [f32]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    moving: Option<&'a [f32]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    clusters: Option<Vec<Described>>,
}

#[derive(serde::Deserialize)]
struct Read {
    flow: Vec<[f64; 3]>,
    valid: Option<Vec<bool>>,
    dynamic: Option<Vec<bool>>,
    cluster: Option<Vec<i32>>,
    confidence: Option<Vec<f64>>,
    moving: Option<Vec<f64>>,
    clusters: Option<Vec<Described>>,
    ego: Option<[[f64; 4]; 4]>,
}

pub(super) fn read(bytes: &[u8]) -> Result<FlowFile, FormatError> {
    let read: Read =
        serde_json::from_slice(bytes).map_err(|error| KIND.malformed(error.to_string()))?;
    let mut flow = Vec::with_capacity(read.flow.len());
    for (row, [x, y, z]) in read.flow.into_iter().enumerate() {
        flow.push([
            check_value(KIND, row, "flow.x", x)?,
            check_value(KIND, row, "flow.y", y)?,
            check_value(KIND, row, "flow.z", z)?,
        ]);
    }
    let probabilities = |name: &str, probabilities: Option<Vec<f64>>| {
        let rows = |probabilities: Vec<f64>| -> Result<Vec<f32>, FormatError> {
            let rows = probabilities.into_iter().enumerate();
            rows.map(|(row, probability)| check_probability(KIND, row, name, probability))
                .collect()
        };
        probabilities.map(rows).transpose()
    };
    Ok(FlowFile {
        flow,
        valid: read.valid,
        dynamic: read.dynamic,
        cluster: read.cluster,
        confidence: probabilities("confidence", read.confidence)?,
        moving: probabilities("moving", read.moving)?,
        clusters: read.clusters.map(clusters).transpose()?,
        ego: read.ego.as_ref().map(ego_motion).transpose()?,
    })
}

fn clusters(described: Vec<Described>) -> Result<Vec<Cluster>, FormatError> {
    let clusters = described.into_iter().enumerate();
    let checked = clusters.map(|(row, described)| described.checked(KIND, row));
    checked.collect()
}

pub(super) fn write(table: &FlowTable<'_>, out: &mut dyn Write) -> Result<(), FormatError> {
    let objects = table.objects;
    serde_json::to_writer(
        &mut *out,
        &Written {
            flow: table.flow,
            valid: table.valid,
            dynamic: table.dynamic,
            ego: table.ego.map(matrix_rows),
            cluster: objects.map(|objects| objects.cluster.as_slice()),
            confidence: objects.map(|objects| objects.confidence.as_slice()),
            moving: objects.map(|objects| objects.moving.as_slice()),
            clusters: objects.map(|objects| objects.clusters.iter().map(Described::from).collect()),
        },
    )
    .map_err(|error| FormatError::Write(error.into()))?;
    out.write_all(b"\n")?;
    Ok(())
}
