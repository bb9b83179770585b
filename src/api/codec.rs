//! The file formats of the API: decoding of clouds and encoding of flow.
//!
//! Independent of HTTP and gRPC types; media types are plain text here.

use super::error::ApiError;
use crate::formats;
use crate::formats::{FlowFormat, FlowTable, MAX_COORDINATE_M, SweepTime};
use crate::job::Report;
use crate::payload::{StoredCloud, StoredFlow, points_to_le_bytes};

/// A format for the encoded flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum AnswerFormat {
    /// One of the file formats.
    File(FlowFormat),
    /// Packed little-endian float32 displacements, x y z, without a header.
    Packed,
}

/// All formats with their media type and file extension. The first is the default.
pub(super) const ANSWER_FORMATS: [(AnswerFormat, &str, &str); 7] = [
    (
        AnswerFormat::File(FlowFormat::Npz),
        "application/x-npz",
        "npz",
    ),
    (
        AnswerFormat::File(FlowFormat::Npy),
        "application/x-npy",
        "npy",
    ),
    (
        AnswerFormat::File(FlowFormat::Feather),
        "application/vnd.apache.arrow.file",
        "feather",
    ),
    (
        AnswerFormat::File(FlowFormat::Ply),
        "application/x-ply",
        "ply",
    ),
    (
        AnswerFormat::File(FlowFormat::Pcd),
        "application/x-pcd",
        "pcd",
    ),
    (AnswerFormat::Packed, "application/octet-stream", "f32"),
    (
        AnswerFormat::File(FlowFormat::Json),
        "application/json",
        "json",
    ),
];

impl AnswerFormat {
    fn entry(self) -> &'static (Self, &'static str, &'static str) {
        let found = ANSWER_FORMATS.iter().find(|(format, ..)| *format == self);
        found.unwrap_or(&ANSWER_FORMATS[0])
    }

    /// The media type.
    pub(super) fn media_type(self) -> &'static str {
        self.entry().1
    }

    /// The file extension, without the dot.
    pub(super) fn ending(self) -> &'static str {
        self.entry().2
    }

    /// Whether the format contains the points of the source sweep.
    pub(super) fn needs_points(self) -> bool {
        matches!(self, Self::File(FlowFormat::Ply | FlowFormat::Pcd))
    }

    /// Selects the format for an `Accept` header by its quality weights. Without a preference it is
    /// npz.
    ///
    /// # Errors
    /// [`ApiError::NotAcceptable`], with a list of the formats.
    pub(super) fn accepted(accept: Option<&str>) -> Result<Self, ApiError> {
        accepted(accept, &ANSWER_FORMATS, "flow")
    }

    /// Encodes a flow. `points` are the points of the source sweep if [`Self::needs_points`], and
    /// may be empty otherwise. `job` is the job id.
    ///
    /// # Errors
    /// [`ApiError::Internal`] if the stored arrays are inconsistent or the encoder fails.
    pub(super) fn encode(
        self,
        flow: &StoredFlow,
        points: &[crate::flow::Point],
        report: &Report,
        job: &str,
    ) -> Result<Vec<u8>, ApiError> {
        let format = match self {
            Self::Packed => return Ok(points_to_le_bytes(&flow.flow)),
            Self::File(format) => format,
        };
        let source = if self.needs_points() {
            points
        } else {
            &flow.flow
        };
        let table = FlowTable {
            source,
            flow: &flow.flow,
            valid: &flow.valid,
            dynamic: flow.dynamic.as_deref(),
            objects: flow.objects.as_ref(),
            ego: flow.ego.as_ref(),
        };
        let mut bytes = Vec::new();
        formats::write_flow(format, &table, &mut bytes).map_err(ApiError::internal)?;
        if format == FlowFormat::Json {
            return with_report(&bytes, report, job);
        }
        Ok(bytes)
    }
}

/// Selects one of `formats` (value, media type, file extension) for an `Accept` header by its
/// quality weights. Without a preference it is the first. `what` is the noun for the error message.
///
/// # Errors
/// [`ApiError::NotAcceptable`], with a list of the formats.
pub(super) fn accepted<F: Copy>(
    accept: Option<&str>,
    formats: &[(F, &str, &str)],
    what: &str,
) -> Result<F, ApiError> {
    let accept = accept.filter(|accept| !accept.trim().is_empty());
    let mut best: Option<(f32, F)> = None;
    for wanted in accept.unwrap_or("*/*").split(',') {
        let mut parts = wanted.split(';').map(str::trim);
        let media = parts.next().unwrap_or_default().to_ascii_lowercase();
        let weight = parts.find_map(|part| part.strip_prefix("q="));
        let weight: f32 = weight.map_or(1.0, |weight| weight.parse().unwrap_or(0.0));
        let known = formats
            .iter()
            .find(|(_, known, _)| *known == media || media == "*/*" || media == "application/*");
        if let Some((format, ..)) = known
            && weight > 0.0
            && best.is_none_or(|(most, _)| weight > most)
        {
            best = Some((weight, *format));
        }
    }
    best.map(|(_, format)| format).ok_or_else(|| {
        let known: Vec<&str> = formats.iter().map(|(_, media, _)| *media).collect();
        ApiError::NotAcceptable(format!("{what} comes as {}", known.join(", ")))
    })
}

/// Adds the fields of the report and the job id to the JSON form of a flow.
fn with_report(json: &[u8], report: &Report, job: &str) -> Result<Vec<u8>, ApiError> {
    let rest = json.strip_prefix(b"{").ok_or(ApiError::Internal)?;
    let mut head = serde_json::to_value(report).map_err(ApiError::internal)?;
    if let Some(fields) = head.as_object_mut() {
        fields.insert("job_id".to_owned(), job.into());
    }
    let mut bytes = serde_json::to_vec(&head).map_err(ApiError::internal)?;
    bytes.pop();
    bytes.push(b',');
    bytes.extend(rest);
    Ok(bytes)
}

/// Upper bounds on the memory that a file takes beside its own bytes.
pub(super) struct DecodingMemory {
    /// Bytes of the decoded clouds: 12 for a point and one for its mask, for each row that the file
    /// declares.
    pub(super) clouds: u64,
    /// Bytes that are held only while the file is decoded. Zero for a file with too many points,
    /// which is refused before.
    pub(super) meanwhile: u64,
}

/// The memory that decoding a file takes, with at most `most` points in a cloud.
///
/// # Errors
/// [`ApiError::BadInput`] or [`ApiError::TooLarge`], with the name of the part and the defect.
pub(super) fn decoding_memory(
    part: &str,
    bytes: &[u8],
    name: Option<&str>,
    most: usize,
) -> Result<DecodingMemory, ApiError> {
    const ROW: u64 = size_of::<crate::flow::Point>() as u64 + 1;
    let rows = formats::declared_rows(bytes, name).map_err(|error| in_part(part, error))?;
    // A file with several arrays is read up to two clouds and their two masks.
    let clouds = rows.min(4 * most) as u64 * ROW;
    let meanwhile = match rows > most {
        true => 0,
        false => formats::working_bytes(bytes, name).map_err(|error| in_part(part, error))?,
    };
    Ok(DecodingMemory { clouds, meanwhile })
}

/// Decodes one cloud in any supported format, with at most `most` points.
///
/// # Errors
/// [`ApiError::BadInput`] or [`ApiError::TooLarge`], with the name of the part and the defect.
pub(super) fn read_cloud(
    part: &str,
    bytes: &[u8],
    name: Option<&str>,
    most: usize,
) -> Result<StoredCloud, ApiError> {
    let cloud =
        formats::read_cloud_within(bytes, name, most).map_err(|error| in_part(part, error))?;
    Ok(StoredCloud {
        points: cloud.points,
        time: name.and_then(SweepTime::from_name),
        ..StoredCloud::default()
    })
}

/// Decodes the two clouds of an `.npz` with at most `most` points each, and their ground masks if
/// present.
///
/// # Errors
/// As for [`read_cloud`].
pub(super) fn read_pair(
    part: &str,
    bytes: &[u8],
    most: usize,
) -> Result<[StoredCloud; 2], ApiError> {
    let pair = formats::read_pair_within(bytes, most).map_err(|error| in_part(part, error))?;
    let (source, target) = match pair.ground {
        Some(ground) => (Some(ground.source), Some(ground.target)),
        None => (None, None),
    };
    Ok([
        StoredCloud {
            points: pair.source,
            ground: source,
            ..StoredCloud::default()
        },
        StoredCloud {
            points: pair.target,
            ground: target,
            ..StoredCloud::default()
        },
    ])
}

/// Refuses raw coordinates that are not finite or too large, as the file decoders do. Rows of three NaN are
/// beams without return.
///
/// # Errors
/// [`ApiError::BadInput`], with the row and the value.
pub(super) fn check_points(part: &str, points: &[crate::flow::Point]) -> Result<(), ApiError> {
    let usable = |value: &f32| value.is_finite() && f64::from(value.abs()) <= MAX_COORDINATE_M;
    let is_valid = |point: &crate::flow::Point| {
        point.iter().all(usable) || point.iter().all(|value| value.is_nan())
    };
    match points.iter().position(|point| !is_valid(point)) {
        None => Ok(()),
        Some(row) => Err(ApiError::BadInput(format!(
            "{part}: row {row} is {:?}, neither three finite coordinates within {MAX_COORDINATE_M} m nor three NaN",
            points[row]
        ))),
    }
}

pub(super) fn in_part(part: &str, error: formats::FormatError) -> ApiError {
    match ApiError::from(error) {
        ApiError::TooLarge(text) => ApiError::TooLarge(format!("{part}: {text}")),
        ApiError::BadInput(text) => ApiError::BadInput(format!("{part}: {text}")),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_heaviest_known_type_is_answered() {
        let npz = AnswerFormat::File(FlowFormat::Npz);
        let ply = AnswerFormat::File(FlowFormat::Ply);
        for (accept, expected) in [
            (None, Some(npz)),
            (Some("*/*"), Some(npz)),
            (Some("application/x-ply"), Some(ply)),
            (
                Some("text/html, application/x-ply;q=0.5, */*;q=0.1"),
                Some(ply),
            ),
            (Some("application/x-npz;q=0, application/x-ply"), Some(ply)),
            (Some("APPLICATION/X-PLY"), Some(ply)),
            (Some("text/html"), None),
            (Some("application/x-npz;q=nonsense"), None),
        ] {
            assert_eq!(AnswerFormat::accepted(accept).ok(), expected, "{accept:?}");
        }
    }
}
