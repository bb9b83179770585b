//! Raw float32 rows: KITTI's `.bin` (x, y, z, intensity) and nuScenes' `.pcd.bin` (x, y, z,
//! intensity, ring).
//!
//! These files have no header. The format is taken from the file name or, failing that, from the
//! row width that gives plausible values.

use std::io::Write;
use std::slice::ChunksExact;

use super::error::{FileKind, FormatError};
use super::limits::{check_rows, check_value, check_within};
use super::scalar::write_floats;
use crate::flow::Point;

/// Largest plausible coordinate, metres: beyond the range of any lidar. Misread columns soon exceed
/// it.
const PLAUSIBLE_M: f32 = 1e4;

/// Largest plausible ring number: lidars have up to 128 rings.
const PLAUSIBLE_RING: f32 = 127.0;

/// Floats per row.
fn width(kind: FileKind) -> usize {
    if kind == FileKind::NuscenesBin { 5 } else { 4 }
}

/// Decides between the two formats, by name and then by plausible values.
///
/// # Errors
/// `Ambiguous` where both are plausible, `Unrecognized` where neither is.
pub(super) fn recognize(bytes: &[u8], name: Option<&str>) -> Result<FileKind, FormatError> {
    let name = name.unwrap_or_default().to_ascii_lowercase();
    if name.ends_with(".pcd.bin") || name.ends_with(".nuscenes.bin") {
        return Ok(FileKind::NuscenesBin);
    }
    if name.ends_with(".kitti.bin") {
        return Ok(FileKind::KittiBin);
    }
    let kitti = plausible(bytes, FileKind::KittiBin);
    let nuscenes = plausible(bytes, FileKind::NuscenesBin);
    match (kitti, nuscenes) {
        (true, false) => Ok(FileKind::KittiBin),
        (false, true) => Ok(FileKind::NuscenesBin),
        (true, true) => Err(FormatError::Ambiguous(
            "its bytes make sense as rows of four floats and of five; name it *.kitti.bin for \
             four (x y z intensity) or *.pcd.bin for five (x y z intensity ring)"
                .to_owned(),
        )),
        (false, false) if is_name(bytes) => Err(FormatError::Unrecognized(
            "it looks like the name of a file instead of the file; with curl, write @ before the name"
                .to_owned(),
        )),
        (false, false) => Err(FormatError::Unrecognized(
            "no known beginning, and neither rows of four floats (x y z intensity in 0..1) nor \
             of five (x y z intensity ring); name it *.kitti.bin or *.pcd.bin to read it anyway"
                .to_owned(),
        )),
    }
}

/// Whether the bytes look like a file's name: one short line of text with a dot in it.
fn is_name(bytes: &[u8]) -> bool {
    const LONGEST: usize = 255;
    let is_of_name = |byte: &u8| byte.is_ascii_graphic() || *byte == b' ';
    bytes.len() <= LONGEST && bytes.iter().all(is_of_name) && bytes.contains(&b'.')
}

fn plausible(bytes: &[u8], kind: FileKind) -> bool {
    let row_len = width(kind) * 4;
    let row_is_plausible = |row: &[u8]| {
        let value = |column: usize| float(&row[column * 4..]);
        let near = (0..3).all(|axis| value(axis).abs() < PLAUSIBLE_M);
        near && match kind {
            FileKind::NuscenesBin => {
                let ring = value(4);
                value(3).is_finite()
                    && ring.fract() == 0.0
                    && (0.0..=PLAUSIBLE_RING).contains(&ring)
            }
            _ => (0.0..=1.0).contains(&value(3)),
        }
    };
    !bytes.is_empty()
        && bytes.len().is_multiple_of(row_len)
        && bytes.chunks_exact(row_len).all(row_is_plausible)
}

/// The float32 at the start of `bytes`; NaN where there are fewer than four bytes.
fn float(bytes: &[u8]) -> f32 {
    bytes
        .first_chunk::<4>()
        .map_or(f32::NAN, |raw| f32::from_le_bytes(*raw))
}

/// Reads all rows of a file of known format, at most `most`.
pub(super) fn read(bytes: &[u8], kind: FileKind, most: usize) -> Result<Vec<Point>, FormatError> {
    let rows = rows(bytes, kind)?;
    check_within(kind, rows.len(), most)?;
    let point = |(row, raw): (usize, &[u8])| {
        let axis = |axis: usize, name: &str| {
            check_value(kind, row, name, f64::from(float(&raw[axis * 4..])))
        };
        Ok([axis(0, "x")?, axis(1, "y")?, axis(2, "z")?])
    };
    rows.enumerate().map(point).collect()
}

/// The rows of a file of known format.
fn rows(bytes: &[u8], kind: FileKind) -> Result<ChunksExact<'_, u8>, FormatError> {
    let row_len = width(kind) * 4;
    if !bytes.len().is_multiple_of(row_len) {
        return Err(kind.malformed(format!(
            "{} bytes are no whole number of rows of {row_len}",
            bytes.len()
        )));
    }
    check_rows(kind, (bytes.len() / row_len) as u64)?;
    Ok(bytes.chunks_exact(row_len))
}

/// Reads the intensities of all rows of a file of known format.
pub(super) fn read_intensity(bytes: &[u8], kind: FileKind) -> Result<Vec<f32>, FormatError> {
    Ok(rows(bytes, kind)?.map(|row| float(&row[12..])).collect())
}

/// Writes KITTI rows with intensity 0.
pub(super) fn write_kitti(out: &mut dyn Write, points: &[Point]) -> Result<(), FormatError> {
    let rows: Vec<[f32; 4]> = points.iter().map(|[x, y, z]| [*x, *y, *z, 0.0]).collect();
    write_floats(out, rows.as_flattened())?;
    Ok(())
}
