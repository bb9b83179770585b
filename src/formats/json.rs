//! Flow as one JSON object: `flow` [[x, y, z], ...], `valid`, and `dynamic` and `ego` if known.
//!
//! Keys of others are stepped over, so that an answer of the service can be read back. It must
//! not know what else such an answer carries.

use std::io::Write;

use crate::flow::Point;

use super::error::{FileKind, FormatError};
use super::limits::check_value;

const KIND: FileKind = FileKind::Json;

#[derive(serde::Serialize)]
struct Written<'a> {
    flow: &'a [Point],
    valid: &'a [bool],
    #[serde(skip_serializing_if = "Option::is_none")]
    dynamic: Option<&'a [bool]>,
    /// Row by row; null where it is not known.
    ego: Option<[[f64; 4]; 4]>,
}

#[derive(serde::Deserialize)]
struct Read {
    flow: Vec<[f64; 3]>,
    valid: Option<Vec<bool>>,
    dynamic: Option<Vec<bool>>,
}

/// Flow and its masks, as read.
pub(super) type Parts = (Vec<Point>, Option<Vec<bool>>, Option<Vec<bool>>);

pub(super) fn read(bytes: &[u8]) -> Result<Parts, FormatError> {
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
    Ok((flow, read.valid, read.dynamic))
}

pub(super) fn write<W: Write>(
    out: &mut W,
    flow: &[Point],
    valid: &[bool],
    dynamic: Option<&[bool]>,
    ego: Option<[[f64; 4]; 4]>,
) -> Result<(), FormatError> {
    serde_json::to_writer(
        &mut *out,
        &Written {
            flow,
            valid,
            dynamic,
            ego,
        },
    )
    .map_err(|error| FormatError::Write(error.into()))?;
    out.write_all(b"\n")?;
    Ok(())
}
