//! Limits on files: the largest counts, and checks of values and declared sizes.
//!
//! Sizes are checked before memory is allocated for them. Independent of any format.

use super::error::{FileKind, FormatError};
use crate::flow::Point;

/// The largest number of points in one cloud.
pub const MAX_POINTS: usize = 50_000_000;

/// The largest magnitude of a coordinate or a displacement, metres. At 1e6 m, adjacent float32
/// values are 6 cm apart.
pub const MAX_COORDINATE_M: f64 = 1e6;

/// Bytes to which any compressed file may decompress, however small it is.
const UNFOLD_FLOOR: u64 = 32 << 20;

/// Above the floor, a file may decompress to this many times its own size. Real sweeps reach 4.
const UNFOLD_RATIO: u64 = 32;

/// The most bytes to which a compressed file may decompress.
pub(super) const UNFOLD_CEILING: u64 = 4 << 30;

/// Bytes to which a compressed file of `file_len` bytes may decompress, all its parts together.
pub(super) fn unfold_limit(file_len: usize) -> u64 {
    unfold_budget(file_len as u64).min(UNFOLD_CEILING)
}

/// Bytes to which `packed` bytes of a stream may decompress, all its parts together: without the ceiling
/// of what is in memory at once.
pub(super) fn unfold_budget(packed: u64) -> u64 {
    packed
        .saturating_mul(UNFOLD_RATIO)
        .saturating_add(UNFOLD_FLOOR)
}

/// Refuses more rows than [`MAX_POINTS`].
pub(super) fn check_rows(kind: FileKind, rows: u64) -> Result<usize, FormatError> {
    match usize::try_from(rows) {
        Ok(rows) if rows <= MAX_POINTS => Ok(rows),
        _ => Err(kind.too_large(format!(
            "{rows} points are declared, {MAX_POINTS} are the most"
        ))),
    }
}

/// Refuses more rows than the caller accepts, before memory is allocated for them.
pub(super) fn check_within(kind: FileKind, rows: usize, most: usize) -> Result<(), FormatError> {
    if rows > most {
        return Err(kind.too_large(format!("{rows} points are declared, {most} are taken")));
    }
    Ok(())
}

/// Refuses a table of `rows` rows of `stride` bytes where only `present` bytes exist. Returns the
/// table's size in bytes.
pub(super) fn check_size(
    kind: FileKind,
    rows: usize,
    stride: usize,
    present: usize,
) -> Result<usize, FormatError> {
    match rows.checked_mul(stride) {
        Some(bytes) if bytes <= present => Ok(bytes),
        _ => Err(kind.malformed(format!(
            "{rows} rows of {stride} bytes are declared where {present} bytes are left"
        ))),
    }
}

/// Refuses NaN and infinities.
pub(super) fn check_finite(
    kind: FileKind,
    row: usize,
    column: &str,
    value: f64,
) -> Result<f64, FormatError> {
    if value.is_finite() {
        return Ok(value);
    }
    Err(FormatError::NotFinite {
        kind,
        row,
        column: column.to_owned(),
        value,
    })
}

/// A finite coordinate or displacement within [`MAX_COORDINATE_M`], in metres, as float32.
pub(super) fn check_value(
    kind: FileKind,
    row: usize,
    column: &str,
    value: f64,
) -> Result<f32, FormatError> {
    check_finite(kind, row, column, value)?;
    if value.abs() > MAX_COORDINATE_M {
        return Err(FormatError::OutOfRange {
            kind,
            row,
            column: column.to_owned(),
            value,
            limit: MAX_COORDINATE_M,
        });
    }
    Ok(value as f32)
}

/// A mask value: zero is false, any other number is true, NaN is refused.
pub(super) fn check_flag(
    kind: FileKind,
    row: usize,
    column: &str,
    value: f64,
) -> Result<bool, FormatError> {
    if value.is_nan() {
        return Err(FormatError::NotFinite {
            kind,
            row,
            column: column.to_owned(),
            value,
        });
    }
    Ok(value != 0.0)
}

/// The index of a cluster: a whole number of 32 bits.
pub(super) fn check_id(
    kind: FileKind,
    row: usize,
    column: &str,
    value: f64,
) -> Result<i32, FormatError> {
    if value.fract() != 0.0 || value.abs() > f64::from(i32::MAX) {
        return Err(kind.malformed(format!(
            "row {row}: {column} is {value}, a whole number of 32 bits is needed"
        )));
    }
    Ok(value as i32)
}

/// The number of a category: whole, 0 to 255.
pub(super) fn check_category(
    kind: FileKind,
    row: usize,
    column: &str,
    value: f64,
) -> Result<u8, FormatError> {
    if value.fract() != 0.0 || !(0.0..=255.0).contains(&value) {
        return Err(kind.malformed(format!(
            "row {row}: {column} is {value}, a category from 0 to 255 is needed"
        )));
    }
    Ok(value as u8)
}

/// A probability, 0 to 1.
pub(super) fn check_probability(
    kind: FileKind,
    row: usize,
    column: &str,
    value: f64,
) -> Result<f32, FormatError> {
    if !(0.0..=1.0).contains(&value) {
        return Err(kind.malformed(format!(
            "row {row}: {column} is {value}, a number from 0 to 1 is needed"
        )));
    }
    Ok(value as f32)
}

/// Refuses points or displacements that could not be read back: not finite, or over
/// [`MAX_COORDINATE_M`].
pub(super) fn check_points(
    kind: FileKind,
    name: &str,
    points: &[Point],
) -> Result<(), FormatError> {
    for (row, point) in points.iter().enumerate() {
        for (value, axis) in point.iter().zip(["x", "y", "z"]) {
            if !value.is_finite() || f64::from(value.abs()) > MAX_COORDINATE_M {
                check_value(kind, row, &format!("{name}.{axis}"), f64::from(*value))?;
            }
        }
    }
    Ok(())
}
