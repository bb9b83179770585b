//! Feather (Arrow IPC file, version 2): named columns in record batches, LZ4-compressed or plain.
//!
//! Metadata is read through arrow's verified flatbuffers. The column buffers are streamed by this
//! module, because arrow's own reader allocates whatever length a file declares. Independent of the
//! meaning of the columns.

use std::io::{Read, Write};
use std::sync::Arc;

use arrow_array::{
    ArrayRef, BooleanArray, Float16Array, Float32Array, Float64Array, Int32Array, Int64Array,
    RecordBatch, StringArray,
};
use arrow_ipc::writer::{FileWriter, IpcWriteOptions};
use arrow_ipc::{CompressionType, Endianness, Message, Precision, Type};
use flatbuffers::VerifierOptions;

use super::error::{FileKind, FormatError, shorten};
use super::limits::{check_rows, unfold_limit};
use super::scalar::{ByteOrder, Scalar};

const KIND: FileKind = FileKind::Feather;

pub(super) const MAGIC: &[u8] = b"ARROW1";

/// Argoverse 2's column names of a displacement, metres.
pub(super) const FLOW_COLUMNS: [&str; 3] = ["flow_tx_m", "flow_ty_m", "flow_tz_m"];

/// Largest padding that writers may add to a buffer, bytes.
const BUFFER_PADDING: u64 = 64;

/// The most columns of a file.
const MAX_COLUMNS: usize = 1024;

/// Bytes of a decoded point; used to limit the number of rows that a file may declare.
const POINT_BYTES: u64 = 12;

#[derive(Clone, Copy)]
enum Stored {
    Number(Scalar),
    /// One bit per row.
    Bit,
    /// Text, dates and the like: skipped.
    Other,
}

struct Column {
    name: String,
    stored: Stored,
    /// Index of the column's data buffer among the batch's buffers.
    buffer: usize,
}

/// One record batch: its description, its body and its number of rows.
struct Batch<'a> {
    header: arrow_ipc::RecordBatch<'a>,
    body: &'a [u8],
    rows: usize,
}

/// A file whose schema and batch directory have been read and checked.
pub(super) struct Table<'a> {
    columns: Vec<Column>,
    batches: Vec<Batch<'a>>,
    rows: usize,
}

impl<'a> Table<'a> {
    /// Reads the footer, the schema and the batches' metadata.
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, FormatError> {
        let trailer = bytes
            .strip_suffix(MAGIC)
            .and_then(|rest| rest.split_last_chunk::<4>())
            .ok_or_else(|| KIND.malformed("it does not end as an arrow file does"))?;
        let (before, footer_len) = trailer;
        let footer_start = usize::try_from(i32::from_le_bytes(*footer_len))
            .ok()
            .and_then(|len| before.len().checked_sub(len))
            .ok_or_else(|| KIND.malformed("the footer is longer than the file"))?;
        let footer = &before[footer_start..];
        let footer = arrow_ipc::root_as_footer_with_opts(&verifier(footer), footer)
            .map_err(|_| KIND.malformed("the footer breaks arrow's rules"))?;
        let schema = footer.schema().ok_or_else(|| KIND.malformed("no schema"))?;
        if schema.endianness() != Endianness::Little {
            return Err(KIND.unsupported("big-endian columns"));
        }
        let fields = schema.fields().map_or(0, |fields| fields.len());
        if fields > MAX_COLUMNS {
            return Err(KIND.too_large(format!("{fields} columns, {MAX_COLUMNS} are the most")));
        }
        let mut columns = Vec::new();
        let mut buffer = 0;
        for field in schema.fields().iter().flatten() {
            let name = field.name().unwrap_or_default().to_owned();
            let (stored, buffers) = layout(&field).ok_or_else(|| {
                let name = shorten(&name);
                KIND.unsupported(format!("column {name} is nested, or holds views of texts"))
            })?;
            // A numeric column has two buffers: the null bitmap, then the data.
            columns.push(Column {
                name,
                stored,
                buffer: buffer + 1,
            });
            buffer += buffers;
        }
        let mut batches = Vec::new();
        let mut rows: u64 = 0;
        let mut end_of_last: usize = 0;
        for block in footer.recordBatches().iter().flatten() {
            let outside = || KIND.malformed("a record batch lies outside the file");
            let start = usize::try_from(block.offset()).map_err(|_| outside())?;
            let metadata_len = usize::try_from(block.metaDataLength()).map_err(|_| outside())?;
            let body_len = usize::try_from(block.bodyLength()).map_err(|_| outside())?;
            // Batches must be in file order and must not overlap, so that none is counted twice.
            if start < end_of_last {
                return Err(KIND.malformed("record batches overlap"));
            }
            let body_start = start.checked_add(metadata_len).ok_or_else(outside)?;
            let end = body_start.checked_add(body_len).ok_or_else(outside)?;
            let metadata = before[..footer_start]
                .get(start..body_start)
                .ok_or_else(outside)?;
            let body = before[..footer_start]
                .get(body_start..end)
                .ok_or_else(outside)?;
            end_of_last = end;
            let header = batch_of(message(metadata)?)?;
            let length = u64::try_from(header.length())
                .map_err(|_| KIND.malformed("a record batch of negative length"))?;
            rows = rows.saturating_add(length);
            batches.push(Batch {
                header,
                body,
                rows: check_rows(KIND, length)?,
            });
        }
        let rows = check_rows(KIND, rows)?;
        if rows as u64 * POINT_BYTES > unfold_limit(bytes.len()) {
            return Err(KIND.too_large(format!(
                "{rows} rows are declared, far more than a file of this length holds"
            )));
        }
        Ok(Self {
            columns,
            batches,
            rows,
        })
    }

    /// Number of rows, over all batches.
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// Names of the columns, for a message.
    pub(super) fn names(&self) -> Vec<String> {
        self.columns
            .iter()
            .map(|column| shorten(&column.name))
            .collect()
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.columns.iter().any(|column| column.name == name)
    }

    /// Whether a column holds floats, as coordinates must.
    pub(super) fn is_float(&self, name: &str) -> bool {
        self.columns.iter().any(|column| {
            column.name == name
                && matches!(column.stored, Stored::Number(scalar) if scalar.is_float())
        })
    }

    /// Reads a numeric column. `check` converts each value, given its row. `None` where the column
    /// does not exist.
    pub(super) fn column<T>(
        &self,
        name: &str,
        check: impl Fn(usize, f64) -> Result<T, FormatError>,
    ) -> Result<Option<Vec<T>>, FormatError> {
        if !self.has(name) {
            return Ok(None);
        }
        let mut column = Vec::new();
        self.each(name, |row, value| {
            if column.is_empty() {
                column.reserve_exact(self.rows);
            }
            column.push(check(row, value)?);
            Ok(())
        })?;
        Ok(Some(column))
    }

    /// Calls `take` with the row and value of every entry of a column; a bit is 0 or 1.
    pub(super) fn each(
        &self,
        name: &str,
        mut take: impl FnMut(usize, f64) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        let Some((node, column)) = self
            .columns
            .iter()
            .enumerate()
            .find(|(_, column)| column.name == name)
        else {
            return Err(KIND.missing(format!("column {name}"), &self.names()));
        };
        let mut first_row = 0;
        for batch in &self.batches {
            let mut data = batch.open(node, column)?;
            match column.stored {
                Stored::Number(scalar) => {
                    scalar.each(
                        ByteOrder::Little,
                        batch.rows,
                        KIND,
                        &mut data,
                        |row, value| take(first_row + row, value),
                    )?;
                }
                Stored::Bit => {
                    let bytes = batch.rows.div_ceil(8);
                    Scalar::U8.each(ByteOrder::Little, bytes, KIND, &mut data, |byte, bits| {
                        let bits = bits as u8;
                        for bit in 0..8.min(batch.rows - byte * 8) {
                            take(first_row + byte * 8 + bit, f64::from(bits >> bit & 1))?;
                        }
                        Ok(())
                    })?;
                }
                Stored::Other => {
                    return Err(KIND.unsupported(format!("column {name} holds no numbers")));
                }
            }
            first_row += batch.rows;
        }
        Ok(())
    }
}

impl<'a> Batch<'a> {
    /// A reader of one column's data, which decompresses as it reads.
    fn open(&self, node: usize, column: &Column) -> Result<Box<dyn Read + 'a>, FormatError> {
        let lacks = || KIND.malformed(format!("a batch lacks column {}", shorten(&column.name)));
        let batch = &self.header;
        let nodes = batch.nodes().ok_or_else(lacks)?;
        let buffers = batch.buffers().ok_or_else(lacks)?;
        if node >= nodes.len() || column.buffer >= buffers.len() {
            return Err(lacks());
        }
        let node = nodes.get(node);
        if usize::try_from(node.length()) != Ok(self.rows) {
            return Err(KIND.malformed(format!(
                "column {} has {} rows in a batch of {}",
                shorten(&column.name),
                node.length(),
                self.rows
            )));
        }
        if node.null_count() != 0 {
            return Err(KIND.unsupported(format!(
                "column {} has {} missing values",
                shorten(&column.name),
                node.null_count()
            )));
        }
        let buffer = buffers.get(column.buffer);
        let start = usize::try_from(buffer.offset()).map_err(|_| lacks())?;
        let len = usize::try_from(buffer.length()).map_err(|_| lacks())?;
        let end = start.checked_add(len).ok_or_else(lacks)?;
        let stored = self.body.get(start..end).ok_or_else(lacks)?;
        let Some(compression) = batch.compression() else {
            return Ok(Box::new(stored));
        };
        if compression.codec() != CompressionType::LZ4_FRAME {
            return Err(KIND.unsupported("compression other than LZ4; write it with lz4 or none"));
        }
        if stored.is_empty() {
            return Ok(Box::new(stored));
        }
        // The first eight bytes are the decompressed length, or -1 for data that is not compressed.
        // At most the bytes that the rows need are read; a length that does not match them is an
        // error.
        let (unfolded, packed) = stored.split_first_chunk::<8>().ok_or_else(lacks)?;
        if i64::from_le_bytes(*unfolded) == -1 {
            return Ok(Box::new(packed));
        }
        let needed = match column.stored {
            Stored::Number(scalar) => self.rows.saturating_mul(scalar.size()),
            Stored::Bit => self.rows.div_ceil(8),
            Stored::Other => 0,
        } as u64;
        let declared = u64::from_le_bytes(*unfolded);
        if !(needed..=needed + BUFFER_PADDING).contains(&declared) {
            return Err(KIND.malformed(format!(
                "column {} declares {declared} bytes where its rows take {needed}",
                shorten(&column.name)
            )));
        }
        Ok(Box::new(lz4_flex::frame::FrameDecoder::new(packed)))
    }
}

/// The limits of the check of a flatbuffer. Tables of a buffer may share their parts, so that it says far
/// more than it holds: it says at most this many times its own length.
fn verifier(buffer: &[u8]) -> VerifierOptions {
    const RATIO: usize = 8;
    const FLOOR: usize = 64 << 10;
    VerifierOptions {
        max_apparent_size: buffer.len().saturating_mul(RATIO).saturating_add(FLOOR),
        ..VerifierOptions::default()
    }
}

/// The flatbuffer message after its length prefix.
fn message(metadata: &[u8]) -> Result<Message<'_>, FormatError> {
    let continued = metadata.strip_prefix(&[0xff; 4]).unwrap_or(metadata);
    let flat = continued
        .get(4..)
        .ok_or_else(|| KIND.malformed("a batch without metadata"))?;
    arrow_ipc::root_as_message_with_opts(&verifier(flat), flat)
        .map_err(|_| KIND.malformed("a batch's metadata breaks arrow's rules"))
}

fn batch_of(message: Message<'_>) -> Result<arrow_ipc::RecordBatch<'_>, FormatError> {
    message
        .header_as_record_batch()
        .ok_or_else(|| KIND.malformed("a batch is no record batch"))
}

/// The storage of a flat column, and its number of buffers. `None` for nested columns, and for views
/// of texts, whose number of buffers differs from batch to batch.
fn layout(field: &arrow_ipc::Field<'_>) -> Option<(Stored, usize)> {
    if field.dictionary().is_some() {
        return Some((Stored::Other, 2));
    }
    let number = match field.type_type() {
        Type::Bool => Some(Stored::Bit),
        Type::FloatingPoint => field.type_as_floating_point().and_then(|float| {
            Some(Stored::Number(match float.precision() {
                Precision::HALF => Scalar::F16,
                Precision::SINGLE => Scalar::F32,
                Precision::DOUBLE => Scalar::F64,
                _ => return None,
            }))
        }),
        Type::Int => field.type_as_int().and_then(|int| {
            Some(Stored::Number(match (int.bitWidth(), int.is_signed()) {
                (8, true) => Scalar::I8,
                (8, false) => Scalar::U8,
                (16, true) => Scalar::I16,
                (16, false) => Scalar::U16,
                (32, true) => Scalar::I32,
                (32, false) => Scalar::U32,
                (64, true) => Scalar::I64,
                (64, false) => Scalar::U64,
                _ => return None,
            }))
        }),
        _ => None,
    };
    match field.type_type() {
        Type::Null => Some((Stored::Other, 0)),
        Type::Bool | Type::FloatingPoint | Type::Int => number.map(|stored| (stored, 2)),
        Type::Decimal
        | Type::Date
        | Type::Time
        | Type::Timestamp
        | Type::Interval
        | Type::Duration
        | Type::FixedSizeBinary => Some((Stored::Other, 2)),
        Type::Utf8 | Type::LargeUtf8 | Type::Binary | Type::LargeBinary => Some((Stored::Other, 3)),
        _ => None,
    }
}

/// A column to be written.
pub(super) enum Values<'a> {
    Floats(Box<dyn Iterator<Item = f32> + 'a>),
    Halves(Box<dyn Iterator<Item = f32> + 'a>),
    Flags(&'a [bool]),
    Ids(&'a [i32]),
    Integers(&'a [i64]),
    Doubles(&'a [f64]),
    Texts(&'a [String]),
}

/// Writes one record batch, LZ4-compressed as in Argoverse 2.
pub(super) fn write(
    out: &mut dyn Write,
    columns: Vec<(&str, Values<'_>)>,
) -> Result<(), FormatError> {
    let encode = |error| KIND.encode(error);
    let array = |(name, values)| {
        let array: ArrayRef = match values {
            Values::Floats(values) => Arc::new(Float32Array::from_iter_values(values)),
            Values::Halves(values) => Arc::new(Float16Array::from_iter_values(
                values.map(half::f16::from_f32),
            )),
            Values::Flags(flags) => Arc::new(BooleanArray::from(flags.to_vec())),
            Values::Ids(ids) => Arc::new(Int32Array::from(ids.to_vec())),
            Values::Integers(values) => Arc::new(Int64Array::from(values.to_vec())),
            Values::Doubles(values) => Arc::new(Float64Array::from(values.to_vec())),
            Values::Texts(texts) => Arc::new(StringArray::from_iter_values(texts)),
        };
        (name, array)
    };
    let batch = RecordBatch::try_from_iter(columns.into_iter().map(array)).map_err(encode)?;
    let options = IpcWriteOptions::default()
        .try_with_compression(Some(CompressionType::LZ4_FRAME))
        .map_err(encode)?;
    let mut writer =
        FileWriter::try_new_with_options(out, &batch.schema(), options).map_err(encode)?;
    writer.write(&batch).map_err(encode)?;
    writer.finish().map_err(encode)
}
