//! Reads LAS 1.0 to 1.4, all point formats, not compressed.
//!
//! A point is an integer per axis, with a scale and an offset in the header. The GPS time of a point
//! is its time.

use super::error::{FileKind, FormatError};
use super::limits::{check_rows, check_size};

const KIND: FileKind = FileKind::Las;

/// The first bytes.
pub(super) const MAGIC: &[u8] = b"LASF";

/// Bytes of the header up to and with the bounds, which every version has.
const HEADER_BYTES: usize = 227;
/// Bytes of the header of version 1.4 up to and with its number of points.
const HEADER_1_4_BYTES: usize = 255;
/// Bit of the point format that marks compressed points.
const COMPRESSED: u8 = 0x80;

/// The least length of a record, and the place of the GPS time in it, by point format.
const FORMATS: [(usize, Option<usize>); 11] = [
    (20, None),
    (28, Some(20)),
    (26, None),
    (34, Some(20)),
    (57, Some(20)),
    (63, Some(20)),
    (30, Some(22)),
    (36, Some(22)),
    (38, Some(22)),
    (59, Some(22)),
    (67, Some(22)),
];

/// An open file.
pub(super) struct Las<'a> {
    records: &'a [u8],
    stride: usize,
    rows: usize,
    scale: [f64; 3],
    offset: [f64; 3],
    time_at: Option<usize>,
}

fn bytes_at<const N: usize>(bytes: &[u8], at: usize) -> Result<[u8; N], FormatError> {
    let found = bytes.get(at..).and_then(|rest| rest.first_chunk::<N>());
    found.copied().ok_or_else(|| {
        let (length, needed) = (bytes.len(), at + N);
        KIND.malformed(format!(
            "it has {length} bytes where its header takes {needed}"
        ))
    })
}

fn u16_at(bytes: &[u8], at: usize) -> Result<u16, FormatError> {
    bytes_at(bytes, at).map(u16::from_le_bytes)
}

fn u32_at(bytes: &[u8], at: usize) -> Result<u32, FormatError> {
    bytes_at(bytes, at).map(u32::from_le_bytes)
}

fn three_at(bytes: &[u8], at: usize, name: &str) -> Result<[f64; 3], FormatError> {
    let mut found = [0.0; 3];
    for (axis, value) in found.iter_mut().enumerate() {
        *value = bytes_at(bytes, at + 8 * axis).map(f64::from_le_bytes)?;
        if !value.is_finite() {
            return Err(KIND.malformed(format!("{name} of its header is {value}")));
        }
    }
    Ok(found)
}

impl<'a> Las<'a> {
    /// Reads the header, and checks it against the bytes that are there.
    ///
    /// # Errors
    /// - `Malformed` for a header that is cut off or contradicts itself, and for more points than the
    ///   file holds.
    /// - `Unsupported` for LAZ, and for an unknown version or point format.
    /// - `TooLarge` for too many points.
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, FormatError> {
        let [major, minor] = bytes_at(bytes, 24)?;
        if (major, minor.min(4)) != (1, minor) {
            return Err(KIND.unsupported(format!("version {major}.{minor}")));
        }
        let [format] = bytes_at(bytes, 104)?;
        if format & COMPRESSED != 0 {
            let detail =
                "its points are compressed (LAZ); unpack them with laszip or pdal translate";
            return Err(KIND.unsupported(detail));
        }
        let known = FORMATS.get(usize::from(format));
        let &(least, time_at) =
            known.ok_or_else(|| KIND.unsupported(format!("point format {format}")))?;
        let stride = usize::from(u16_at(bytes, 105)?);
        if stride < least {
            return Err(KIND.malformed(format!(
                "points of format {format} have {least} bytes, its have {stride}"
            )));
        }
        let mut rows = u64::from(u32_at(bytes, 107)?);
        let mut header = HEADER_BYTES;
        if minor == 4 {
            header = HEADER_1_4_BYTES;
            rows = bytes_at(bytes, 247).map(u64::from_le_bytes)?;
        }
        let rows = check_rows(KIND, rows)?;
        let first = u32_at(bytes, 96)? as usize;
        let records = bytes.get(first..).filter(|_| first >= header);
        let records = records.ok_or_else(|| {
            let length = bytes.len();
            KIND.malformed(format!("its points begin at byte {first} of {length}"))
        })?;
        let size = check_size(KIND, rows, stride, records.len())?;
        Ok(Self {
            records: &records[..size],
            stride,
            rows,
            scale: three_at(bytes, 131, "a scale")?,
            offset: three_at(bytes, 155, "an offset")?,
            time_at,
        })
    }

    /// Number of points.
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// Whether the points have times.
    pub(super) fn has_times(&self) -> bool {
        self.time_at.is_some()
    }

    /// The intensity of each row.
    pub(super) fn intensities(&self) -> impl Iterator<Item = u16> {
        // It follows the three coordinates in every point format.
        let records = self.records.chunks_exact(self.stride);
        records.map(|record| u16::from_le_bytes([record[12], record[13]]))
    }

    /// Calls `take` for each row with x, y and z in the file's unit, and the GPS time; NaN without
    /// one.
    ///
    /// # Errors
    /// Those of `take`.
    pub(super) fn each(
        &self,
        mut take: impl FnMut(usize, [f64; 4]) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        for (row, record) in self.records.chunks_exact(self.stride).enumerate() {
            let mut values = [f64::NAN; 4];
            for (axis, value) in values.iter_mut().take(3).enumerate() {
                let steps = i32::from_le_bytes(bytes_at(record, 4 * axis)?);
                *value = f64::from(steps) * self.scale[axis] + self.offset[axis];
            }
            if let Some(at) = self.time_at {
                values[3] = f64::from_le_bytes(bytes_at(record, at)?);
            }
            take(row, values)?;
        }
        Ok(())
    }
}
