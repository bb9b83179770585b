//! PCD, the Point Cloud Library's format: ascii, binary and binary_compressed (LZF, column by
//! column).
//!
//! Reads the wanted fields and skips the others. Independent of the meaning of the fields.

use std::borrow::Cow;
use std::io::Write;

use super::error::{FileKind, FormatError, shorten};
use super::limits::{check_rows, check_size, unfold_limit};
use super::lines::{header_line, next_line};
use super::lzf;
use super::scalar::{ByteOrder, Scalar};

const KIND: FileKind = FileKind::Pcd;

/// Size limit of a header, bytes. Typical ones have about two hundred; comments may make them
/// longer.
const MAX_HEADER: usize = 64 << 10;

struct Field {
    name: String,
    scalar: Scalar,
    /// Numbers per point.
    count: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Ascii,
    Binary,
    Compressed,
}

/// A file whose header has been read.
pub(super) struct Pcd<'a> {
    fields: Vec<Field>,
    rows: usize,
    encoding: Encoding,
    body: &'a [u8],
    file_len: usize,
}

/// The header's entries, as found.
#[derive(Default)]
struct Entries<'a> {
    fields: Option<Vec<&'a str>>,
    sizes: Option<Vec<&'a str>>,
    types: Option<Vec<&'a str>>,
    counts: Option<Vec<&'a str>>,
    width: Option<u64>,
    height: Option<u64>,
    points: Option<u64>,
}

impl<'a> Pcd<'a> {
    /// Reads the header and checks that its counts agree.
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, FormatError> {
        let mut entries = Entries::default();
        let mut rest = bytes;
        let encoding = loop {
            let left = MAX_HEADER.saturating_sub(bytes.len() - rest.len());
            let line = header_line(&mut rest, left)
                .map_err(|_| KIND.malformed("no DATA line in the first 64 KiB"))?
                .ok_or_else(|| KIND.malformed("no DATA line"))?;
            let line = std::str::from_utf8(line)
                .map_err(|_| KIND.malformed("the header is not text"))?
                .trim();
            let wrong = || KIND.malformed(format!("header line {:?}", shorten(line)));
            let (keyword, value) = line
                .split_once(|c: char| c.is_ascii_whitespace())
                .unwrap_or((line, ""));
            let words = || Some(value.split_ascii_whitespace().collect::<Vec<&str>>());
            let number = || value.trim().parse::<u64>().map(Some).map_err(|_| wrong());
            match keyword {
                "FIELDS" | "COLUMNS" => entries.fields = words(),
                "SIZE" => entries.sizes = words(),
                "TYPE" => entries.types = words(),
                "COUNT" => entries.counts = words(),
                "WIDTH" => entries.width = number()?,
                "HEIGHT" => entries.height = number()?,
                "POINTS" => entries.points = number()?,
                "DATA" => match value.trim() {
                    "ascii" => break Encoding::Ascii,
                    "binary" => break Encoding::Binary,
                    "binary_compressed" => break Encoding::Compressed,
                    _ => return Err(wrong()),
                },
                "VERSION" | "VIEWPOINT" | "" => {}
                comment if comment.starts_with('#') => {}
                _ => return Err(wrong()),
            }
        };
        let rows = rows(&entries)?;
        let fields = fields(&entries)?;
        Ok(Self {
            fields,
            rows,
            encoding,
            body: rest,
            file_len: bytes.len(),
        })
    }

    /// The number of points declared.
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// The type of the field `wanted`, where it exists and has one number per point.
    pub(super) fn field(&self, wanted: &str) -> Option<Scalar> {
        let found = self
            .fields
            .iter()
            .find(|field| field.name == wanted && field.count == 1)?;
        Some(found.scalar)
    }

    /// Checks the declared counts against the bytes present. Then calls `take` with the row and
    /// values of every point, the values being those of the `wanted` fields in that order.
    pub(super) fn each(
        &self,
        wanted: &[&str],
        mut take: impl FnMut(usize, &[f64]) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        let indices = self.indices(wanted)?;
        let mut values = vec![0.0; wanted.len()];
        if self.encoding == Encoding::Ascii {
            let numbers = self.sum(|field| field.count)?;
            // Each number takes at least a digit and a separator.
            check_size(
                KIND,
                self.rows,
                numbers.saturating_mul(2),
                self.body.len() + 1,
            )?;
            let columns = self.offsets(&indices, |field| field.count);
            let mut body = self.body;
            for row in 0..self.rows {
                ascii_row(&mut body, numbers, &columns, &mut values).ok_or_else(|| {
                    KIND.malformed(format!("point {row} is not a row of {numbers} numbers"))
                })?;
                take(row, &values)?;
            }
            return Ok(());
        }
        let stride = self.stride()?;
        let offsets = self.offsets(&indices, |field| field.scalar.size() * field.count);
        let data = self.data(stride)?;
        for row in 0..self.rows {
            for ((value, &index), &offset) in values.iter_mut().zip(&indices).zip(&offsets) {
                let scalar = self.fields[index].scalar;
                let at = match self.encoding {
                    // Column by column: the numbers of one field are contiguous.
                    Encoding::Compressed => offset * self.rows + row * scalar.size(),
                    _ => row * stride + offset,
                };
                *value = data
                    .get(at..)
                    .and_then(|bytes| scalar.decode(bytes, ByteOrder::Little))
                    .ok_or_else(|| KIND.malformed(format!("point {row} ends early")))?;
            }
            take(row, &values)?;
        }
        Ok(())
    }

    /// Bytes of the body once it is decompressed; zero where it is not compressed.
    pub(super) fn unfolded_bytes(&self) -> Result<u64, FormatError> {
        if self.encoding != Encoding::Compressed {
            return Ok(0);
        }
        Ok(self.packed(self.stride()?)?.1 as u64)
    }

    /// Bytes of a point in a binary body.
    fn stride(&self) -> Result<usize, FormatError> {
        self.sum(|field| field.scalar.size().saturating_mul(field.count))
    }

    /// The binary body, decompressed where it is compressed.
    fn data(&self, stride: usize) -> Result<Cow<'a, [u8]>, FormatError> {
        if self.encoding == Encoding::Binary {
            check_size(KIND, self.rows, stride, self.body.len())?;
            return Ok(Cow::Borrowed(self.body));
        }
        let (packed, unfolded_len) = self.packed(stride)?;
        lzf::decompress(packed, unfolded_len)
            .map(Cow::Owned)
            .map_err(|detail| KIND.malformed(format!("compressed data: {detail}")))
    }

    /// The compressed body, and its length once it is decompressed.
    fn packed(&self, stride: usize) -> Result<(&'a [u8], usize), FormatError> {
        let early = || KIND.malformed("the compressed data ends early");
        let (packed_len, rest) = self.body.split_first_chunk::<4>().ok_or_else(early)?;
        let (unfolded_len, rest) = rest.split_first_chunk::<4>().ok_or_else(early)?;
        let packed = rest
            .get(..u32::from_le_bytes(*packed_len) as usize)
            .ok_or_else(early)?;
        let unfolded_len = u32::from_le_bytes(*unfolded_len) as usize;
        if self.rows.checked_mul(stride) != Some(unfolded_len) {
            return Err(KIND.malformed(format!(
                "{} points of {stride} bytes are declared, the data unfolds to {unfolded_len}",
                self.rows
            )));
        }
        if unfolded_len as u64 > unfold_limit(self.file_len) {
            return Err(KIND.too_large(format!(
                "the data unfolds to {unfolded_len} bytes, far more than a file of this length holds"
            )));
        }
        Ok((packed, unfolded_len))
    }

    fn indices(&self, wanted: &[&str]) -> Result<Vec<usize>, FormatError> {
        let index = |name: &&str| {
            let is_it = |field: &Field| field.name == *name && field.count == 1;
            self.fields.iter().position(is_it).ok_or_else(|| {
                let names: Vec<String> = self
                    .fields
                    .iter()
                    .map(|field| shorten(&field.name))
                    .collect();
                KIND.missing(format!("field {name}"), &names)
            })
        };
        wanted.iter().map(index).collect()
    }

    /// A sum over all fields, such as the bytes of a point.
    fn sum(&self, size: impl Fn(&Field) -> usize) -> Result<usize, FormatError> {
        self.fields
            .iter()
            .try_fold(0_usize, |sum, field| sum.checked_add(size(field)))
            .filter(|&sum| sum <= MAX_HEADER)
            .ok_or_else(|| KIND.too_large("a point of more than 64 KiB"))
    }

    fn offsets(&self, indices: &[usize], size: impl Fn(&Field) -> usize) -> Vec<usize> {
        indices
            .iter()
            .map(|&index| self.fields[..index].iter().map(&size).sum())
            .collect()
    }
}

fn rows(entries: &Entries<'_>) -> Result<usize, FormatError> {
    let area = match (entries.width, entries.height) {
        (Some(width), height) => Some(
            width
                .checked_mul(height.unwrap_or(1))
                .ok_or_else(|| KIND.too_large("WIDTH x HEIGHT overflows"))?,
        ),
        (None, _) => None,
    };
    let rows = match (entries.points, area) {
        (Some(points), Some(area)) if points != area => {
            return Err(KIND.malformed(format!("POINTS is {points}, WIDTH x HEIGHT is {area}")));
        }
        (Some(rows), _) | (None, Some(rows)) => rows,
        (None, None) => return Err(KIND.malformed("neither POINTS nor WIDTH is given")),
    };
    check_rows(KIND, rows)
}

fn fields(entries: &Entries<'_>) -> Result<Vec<Field>, FormatError> {
    let lacks = |what: &str| KIND.malformed(format!("the header lacks {what}"));
    let names = entries.fields.as_deref().ok_or_else(|| lacks("FIELDS"))?;
    let sizes = entries.sizes.as_deref().ok_or_else(|| lacks("SIZE"))?;
    let types = entries.types.as_deref().ok_or_else(|| lacks("TYPE"))?;
    let ones = vec!["1"; names.len()];
    let counts = entries.counts.as_deref().unwrap_or(&ones);
    if sizes.len() != names.len() || types.len() != names.len() || counts.len() != names.len() {
        return Err(KIND.malformed("FIELDS, SIZE, TYPE and COUNT differ in length"));
    }
    let field = |index: usize| {
        let scalar = match (types[index], sizes[index]) {
            ("I", "1") => Scalar::I8,
            ("I", "2") => Scalar::I16,
            ("I", "4") => Scalar::I32,
            ("I", "8") => Scalar::I64,
            ("U", "1") => Scalar::U8,
            ("U", "2") => Scalar::U16,
            ("U", "4") => Scalar::U32,
            ("U", "8") => Scalar::U64,
            ("F", "4") => Scalar::F32,
            ("F", "8") => Scalar::F64,
            (kind, size) => {
                let (kind, size) = (shorten(kind), shorten(size));
                return Err(KIND.malformed(format!("a field of TYPE {kind} and SIZE {size}")));
            }
        };
        let count: usize = counts[index]
            .parse()
            .ok()
            .filter(|&count| count <= MAX_HEADER)
            .ok_or_else(|| KIND.malformed(format!("a COUNT of {}", shorten(counts[index]))))?;
        Ok(Field {
            name: names[index].to_owned(),
            scalar,
            count,
        })
    };
    (0..names.len()).map(field).collect()
}

fn ascii_row(
    body: &mut &[u8],
    numbers: usize,
    columns: &[usize],
    values: &mut [f64],
) -> Option<()> {
    let line = std::str::from_utf8(next_line(body)?).ok()?;
    let mut found = 0;
    for (index, word) in line.split_ascii_whitespace().enumerate() {
        for (value, &column) in values.iter_mut().zip(columns) {
            if column == index {
                *value = word.parse().ok()?;
            }
        }
        found = index + 1;
    }
    (found == numbers).then_some(())
}

/// The bytes of PCL's field `rgb`: the number 0x00rrggbb, reinterpreted as a float.
pub(super) fn rgb([red, green, blue]: [u8; 3]) -> [u8; 4] {
    [blue, green, red, 0]
}

/// Writes the header of a binary file of `rows` points; fields as (name, size in bytes, type).
pub(super) fn write_header(
    out: &mut dyn Write,
    rows: usize,
    fields: &[(&str, u8, char)],
) -> Result<(), FormatError> {
    let join = |text: fn(&(&str, u8, char)) -> String| {
        fields.iter().map(text).collect::<Vec<String>>().join(" ")
    };
    writeln!(
        out,
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7"
    )?;
    writeln!(out, "FIELDS {}", join(|field| field.0.to_owned()))?;
    writeln!(out, "SIZE {}", join(|field| field.1.to_string()))?;
    writeln!(out, "TYPE {}", join(|field| field.2.to_string()))?;
    writeln!(out, "COUNT {}", join(|_| "1".to_owned()))?;
    writeln!(
        out,
        "WIDTH {rows}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {rows}\nDATA binary"
    )?;
    Ok(())
}
