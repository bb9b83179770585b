//! numpy's `.npy`: one array after a header that is a Python dictionary literal.
//!
//! The header is parsed by hand; nothing in it is executed.

use std::io::{Read, Write};

use super::error::{FileKind, FormatError, shorten};
use super::limits::{MAX_COORDINATE_M, check_rows, check_value, check_within};
use super::scalar::{ByteOrder, Scalar, write_floats};
use crate::flow::Point;

pub(super) const MAGIC: &[u8] = b"\x93NUMPY";

/// Size limit of a header, bytes. Typical ones have about a hundred; numpy itself refuses to parse
/// more than 10,000.
const MAX_HEADER: usize = 10_000;

/// The contents of a header.
#[derive(Debug)]
pub(super) struct Header {
    pub(super) scalar: Scalar,
    pub(super) order: ByteOrder,
    pub(super) fortran: bool,
    pub(super) shape: Vec<usize>,
    /// Size of the header in the file, bytes.
    pub(super) len: usize,
}

impl Header {
    /// Reads magic, version and dictionary, and leaves `reader` at the data.
    pub(super) fn read<R: Read + ?Sized>(
        kind: FileKind,
        reader: &mut R,
    ) -> Result<Self, FormatError> {
        let ends = |_| kind.malformed("the array header ends too early");
        let mut start = [0_u8; 8];
        reader.read_exact(&mut start).map_err(ends)?;
        if &start[..6] != MAGIC {
            return Err(kind.malformed("an array does not begin with numpy's magic"));
        }
        let (prefix, dictionary_len) = match start[6] {
            1 => {
                let mut len = [0_u8; 2];
                reader.read_exact(&mut len).map_err(ends)?;
                (10, usize::from(u16::from_le_bytes(len)))
            }
            2 | 3 => {
                let mut len = [0_u8; 4];
                reader.read_exact(&mut len).map_err(ends)?;
                (12, u32::from_le_bytes(len) as usize)
            }
            version => return Err(kind.unsupported(format!("npy version {version}"))),
        };
        if dictionary_len > MAX_HEADER {
            return Err(kind.malformed(format!("an array header of {dictionary_len} bytes")));
        }
        let mut dictionary = vec![0_u8; dictionary_len];
        reader.read_exact(&mut dictionary).map_err(ends)?;
        let text = std::str::from_utf8(&dictionary)
            .map_err(|_| kind.malformed("the array header is not text"))?;
        let (scalar, order) = parse_type(kind, field(kind, text, "descr")?)?;
        let fortran = match field(kind, text, "fortran_order")? {
            value if value.starts_with("True") => true,
            value if value.starts_with("False") => false,
            value => {
                return Err(kind.malformed(format!("fortran_order is {:?}", shorten(value))));
            }
        };
        let shape = parse_shape(kind, field(kind, text, "shape")?)?;
        let len = prefix + dictionary_len;
        Ok(Self {
            scalar,
            order,
            fortran,
            shape,
            len,
        })
    }

    /// Size of the data by the declared shape, bytes.
    pub(super) fn data_len(&self, kind: FileKind) -> Result<u64, FormatError> {
        self.shape
            .iter()
            .try_fold(self.scalar.size() as u64, |bytes, &side| {
                bytes.checked_mul(side as u64)
            })
            .ok_or_else(|| kind.too_large(format!("an array of shape {:?}", self.shape)))
    }

    /// The first dimension, by which memory is allocated.
    pub(super) fn rows(&self) -> usize {
        self.shape.first().copied().unwrap_or(0)
    }

    /// Rows and columns of a two-dimensional array.
    pub(super) fn table(&self) -> Option<(usize, usize)> {
        match self.shape[..] {
            [rows, columns] => Some((rows, columns)),
            _ => None,
        }
    }
}

/// The text after `'name':`, up to the end of the dictionary.
fn field<'a>(kind: FileKind, text: &'a str, name: &str) -> Result<&'a str, FormatError> {
    let missing = || kind.malformed(format!("the array header lacks {name}"));
    let (_, after) = text.split_once(&format!("'{name}'")).ok_or_else(missing)?;
    let (colon, value) = after.split_once(':').ok_or_else(missing)?;
    if colon.trim().is_empty() {
        Ok(value.trim_start())
    } else {
        Err(missing())
    }
}

fn parse_type(kind: FileKind, value: &str) -> Result<(Scalar, ByteOrder), FormatError> {
    if value.starts_with('[') {
        return Err(kind.unsupported("structured arrays are not read; save columns as N x 3"));
    }
    let name = value
        .strip_prefix('\'')
        .and_then(|rest| rest.split_once('\''))
        .map(|(name, _)| name)
        .ok_or_else(|| kind.malformed("the array header has no type"))?;
    if name.contains('O') {
        return Err(kind.unsupported("object arrays hold pickled Python and are refused"));
    }
    let (order, code) = match name.split_at_checked(1) {
        Some(("<" | "|" | "=", code)) => (ByteOrder::Little, code),
        Some((">", code)) => (ByteOrder::Big, code),
        _ => return Err(kind.malformed(format!("array type {:?}", shorten(name)))),
    };
    let scalar = match code {
        "f2" => Scalar::F16,
        "f4" => Scalar::F32,
        "f8" => Scalar::F64,
        "b1" | "u1" => Scalar::U8,
        "i1" => Scalar::I8,
        "i2" => Scalar::I16,
        "u2" => Scalar::U16,
        "i4" => Scalar::I32,
        "u4" => Scalar::U32,
        "i8" => Scalar::I64,
        "u8" => Scalar::U64,
        _ => return Err(kind.unsupported(format!("arrays of type {:?}", shorten(name)))),
    };
    Ok((scalar, order))
}

fn parse_shape(kind: FileKind, value: &str) -> Result<Vec<usize>, FormatError> {
    let wrong = || kind.malformed("the array header's shape is not a tuple of counts");
    let inside = value
        .strip_prefix('(')
        .and_then(|rest| rest.split_once(')'))
        .map(|(inside, _)| inside)
        .ok_or_else(wrong)?;
    let sides = inside
        .split(',')
        .map(str::trim)
        .filter(|side| !side.is_empty());
    let shape: Vec<usize> = sides
        .map(|side| side.parse().map_err(|_| wrong()))
        .collect::<Result<_, _>>()?;
    if shape.len() > 32 {
        Err(wrong())
    } else {
        Ok(shape)
    }
}

/// The origin of an array, for messages: the kind of file, and the array's name there (empty for
/// `.npy`).
#[derive(Clone, Copy)]
pub(super) struct ArrayPath<'a> {
    pub(super) kind: FileKind,
    pub(super) array: &'a str,
}

impl ArrayPath<'_> {
    fn column(&self, axis: usize) -> String {
        let axis = ["x", "y", "z"][axis.min(2)];
        if self.array.is_empty() {
            axis.to_owned()
        } else {
            format!("{}.{axis}", self.array)
        }
    }

    fn described(&self) -> String {
        if self.array.is_empty() {
            "the array".to_owned()
        } else {
            format!("array {}", self.array)
        }
    }
}

/// An array with so many rows and more columns than this is taken for transposed: its rows are x, y,
/// z and perhaps others.
const TRANSPOSED_ROWS: core::ops::RangeInclusive<usize> = 3..=8;
const MOST_COLUMNS: usize = 64;

/// The first three columns of an N x k array of floats, k >= 3, as N points in metres.
///
/// The caller must check that the declared bytes exist. Memory is allocated for N points only.
pub(super) fn read_points<R: Read + ?Sized>(
    array_path: ArrayPath<'_>,
    header: &Header,
    reader: &mut R,
) -> Result<Vec<Point>, FormatError> {
    let kind = array_path.kind;
    let (rows, columns) = match header.table() {
        Some((rows, columns)) if columns >= 3 && header.scalar.is_float() => (rows, columns),
        _ => {
            let numbers = match header.scalar.is_float() {
                true => "floats",
                false => "integers",
            };
            return Err(kind.unsupported(format!(
                "{} has shape {:?} of {numbers} with {} bytes each, where N x 3 floats are needed",
                array_path.described(),
                header.shape,
                header.scalar.size()
            )));
        }
    };
    if TRANSPOSED_ROWS.contains(&rows) && columns > MOST_COLUMNS {
        return Err(kind.unsupported(format!(
            "{} has shape {:?}, but each row is a point: save the transposed array, N x 3",
            array_path.described(),
            header.shape
        )));
    }
    let rows = check_rows(kind, rows as u64)?;
    let count = if header.fortran {
        rows * 3
    } else {
        rows.saturating_mul(columns)
    };
    let mut points = vec![[0.0; 3]; rows];
    header
        .scalar
        .each(header.order, count, kind, reader, |index, value| {
            let (row, axis) = if header.fortran {
                (index % rows, index / rows)
            } else {
                (index / columns, index % columns)
            };
            if axis < 3 {
                if !value.is_finite() || value.abs() > MAX_COORDINATE_M {
                    check_value(kind, row, &array_path.column(axis), value)?;
                }
                points[row][axis] = value as f32;
            }
            Ok(())
        })?;
    Ok(points)
}

/// Reads a column of N numbers. `check` converts each value, given its row.
pub(super) fn read_column<R: Read + ?Sized, T>(
    array_path: ArrayPath<'_>,
    header: &Header,
    reader: &mut R,
    check: impl Fn(usize, f64) -> Result<T, FormatError>,
) -> Result<Vec<T>, FormatError> {
    let rows = match header.shape[..] {
        [rows] | [rows, 1] => check_rows(array_path.kind, rows as u64)?,
        _ => {
            return Err(array_path.kind.unsupported(format!(
                "{} has shape {:?} where one value a point is needed",
                array_path.described(),
                header.shape
            )));
        }
    };
    let mut column = Vec::with_capacity(rows);
    header
        .scalar
        .each(header.order, rows, array_path.kind, reader, |row, value| {
            column.push(check(row, value)?);
            Ok(())
        })?;
    Ok(column)
}

/// Reads a 4 x 4 matrix of floats, row by row.
pub(super) fn read_matrix<R: Read + ?Sized>(
    array_path: ArrayPath<'_>,
    header: &Header,
    reader: &mut R,
) -> Result<[[f64; 4]; 4], FormatError> {
    if header.shape != [4, 4] || !header.scalar.is_float() {
        return Err(array_path.kind.unsupported(format!(
            "{} has shape {:?} where a 4 x 4 matrix of floats is needed",
            array_path.described(),
            header.shape
        )));
    }
    let mut matrix = [[0.0; 4]; 4];
    header
        .scalar
        .each(header.order, 16, array_path.kind, reader, |index, value| {
            let (row, column) = if header.fortran {
                (index % 4, index / 4)
            } else {
                (index / 4, index % 4)
            };
            matrix[row][column] = value;
            Ok(())
        })?;
    Ok(matrix)
}

/// The number of rows that a `.npy` file declares.
pub(super) fn declared_rows(bytes: &[u8]) -> Result<usize, FormatError> {
    Ok(Header::read(FileKind::Npy, &mut &bytes[..])?.rows())
}

/// Reads a whole `.npy` file of N x k floats, k >= 3, with at most `most` rows, as N points in
/// metres.
pub(super) fn read_file(bytes: &[u8], most: usize) -> Result<Vec<Point>, FormatError> {
    let kind = FileKind::Npy;
    let mut rest = bytes;
    let header = Header::read(kind, &mut rest)?;
    let declared = header.data_len(kind)?;
    if declared > rest.len() as u64 {
        return Err(kind.malformed(format!(
            "shape {:?} needs {declared} bytes where {} are left",
            header.shape,
            rest.len()
        )));
    }
    check_within(kind, header.rows(), most)?;
    read_points(ArrayPath { kind, array: "" }, &header, &mut rest)
}

/// Writes the header of a C-order array; `descr` and `shape` are Python literals.
pub(super) fn write_header(
    out: &mut dyn Write,
    descr: &str,
    shape: &str,
) -> Result<(), FormatError> {
    const ALIGNMENT: usize = 64;
    let mut text = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
    let unpadded = MAGIC.len() + 4 + text.len() + 1;
    let padding = unpadded.next_multiple_of(ALIGNMENT) - unpadded;
    text.extend(std::iter::repeat_n(' ', padding));
    text.push('\n');
    let len = u16::try_from(text.len()).map_err(|_| FileKind::Npy.encode("header too long"))?;
    out.write_all(MAGIC)?;
    out.write_all(&[1, 0])?;
    out.write_all(&len.to_le_bytes())?;
    out.write_all(text.as_bytes())?;
    Ok(())
}

/// Writes N x 3 float32, little endian.
pub(super) fn write_points(out: &mut dyn Write, points: &[Point]) -> Result<(), FormatError> {
    write_header(out, "<f4", &format!("({}, 3)", points.len()))?;
    write_floats(out, points.as_flattened())
}

/// Writes N booleans.
pub(super) fn write_mask(out: &mut dyn Write, mask: &[bool]) -> Result<(), FormatError> {
    write_header(out, "|b1", &format!("({},)", mask.len()))?;
    let bytes: Vec<u8> = mask.iter().map(|&flag| u8::from(flag)).collect();
    out.write_all(&bytes)?;
    Ok(())
}

/// Writes N int32, little endian.
pub(super) fn write_ids(out: &mut dyn Write, ids: &[i32]) -> Result<(), FormatError> {
    write_header(out, "<i4", &format!("({},)", ids.len()))?;
    let bytes: Vec<u8> = ids.iter().flat_map(|id| id.to_le_bytes()).collect();
    out.write_all(&bytes)?;
    Ok(())
}

/// Writes N uint32, little endian.
pub(super) fn write_counts(out: &mut dyn Write, counts: &[u32]) -> Result<(), FormatError> {
    write_header(out, "<u4", &format!("({},)", counts.len()))?;
    let bytes: Vec<u8> = counts.iter().flat_map(|n| n.to_le_bytes()).collect();
    out.write_all(&bytes)?;
    Ok(())
}

/// Writes N float32, little endian.
pub(super) fn write_values(out: &mut dyn Write, values: &[f32]) -> Result<(), FormatError> {
    write_header(out, "<f4", &format!("({},)", values.len()))?;
    write_floats(out, values)
}

/// Writes a 4 x 4 float64 matrix, row by row, little endian.
pub(super) fn write_matrix(out: &mut dyn Write, matrix: &[[f64; 4]; 4]) -> Result<(), FormatError> {
    write_header(out, "<f8", "(4, 4)")?;
    for value in matrix.as_flattened() {
        out.write_all(&value.to_le_bytes())?;
    }
    Ok(())
}
