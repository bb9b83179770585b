//! Manifests as Parquet.

use std::collections::HashMap;
use std::sync::Arc;

use arrow_array::RecordBatch;
use arrow_array::cast::AsArray;
use arrow_schema::{DataType as Type, Field, Schema};
use bytes::Bytes;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};

use super::footer;
use super::pages::CheckedPages;
use super::table::{COLUMNS, MAX_BYTES, MAX_ROWS, ManifestError, Table, known};

/// Most values that a row has in all columns: a pose has 16.
const VALUES_PER_ROW: usize = 16 + COLUMNS.len();

/// Reads the known columns of a Parquet file.
///
/// # Errors
/// [`ManifestError`]. The reader may panic at a damaged file.
pub(super) fn read(bytes: Bytes) -> Result<Table, ManifestError> {
    let unreadable = |error: &dyn std::fmt::Display| ManifestError::Unreadable(error.to_string());
    footer::check(&bytes).map_err(|error| unreadable(&error))?;
    // Values of a dictionary stay in it: as views, many rows of one long value take little memory.
    let plain = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
    let stored = ArrowReaderMetadata::load(&bytes, plain.clone());
    let stored = stored.map_err(|error| unreadable(&error))?;
    let views = stored.schema().fields().iter().map(|field| {
        let kind = match field.data_type() {
            Type::Utf8 => Type::Utf8View,
            kind => kind.clone(),
        };
        Field::new(field.name(), kind, field.is_nullable())
    });
    let views = Arc::new(Schema::new(views.collect::<Vec<_>>()));
    let rows = stored.metadata().file_metadata().num_rows();
    let rows = usize::try_from(rows).map_err(|_| ManifestError::TooLarge)?;
    if rows > MAX_ROWS {
        return Err(ManifestError::TooLarge);
    }
    // Sweeps have names that differ: a row takes more than a byte.
    if rows > bytes.len() {
        let size = bytes.len();
        return Err(unreadable(&format!("{size} bytes claim {rows} rows")));
    }
    let metadata =
        ArrowReaderMetadata::try_new(Arc::clone(stored.metadata()), plain.with_schema(views));
    let metadata = metadata.map_err(|error| unreadable(&error))?;
    let pages = CheckedPages::new(bytes, (rows * VALUES_PER_ROW) as u64);
    let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(pages, metadata);
    let fields = builder.schema().fields().iter();
    let names: Vec<String> = fields.map(|field| field.name().clone()).collect();
    let indices = names.iter().enumerate();
    let indices = indices
        .filter(|(_, name)| known(name).is_some())
        .map(|(index, _)| index);
    let mask = ProjectionMask::roots(builder.parquet_schema(), indices);
    let reader = builder.with_projection(mask).with_batch_size(8192).build();
    let mut table = Table {
        names,
        rows: Vec::new(),
    };
    let mut left = MAX_BYTES;
    for batch in reader.map_err(|error| unreadable(&error))? {
        let batch = batch.map_err(|error| unreadable(&error))?;
        // Without a known column the row groups alone say how many rows there are.
        if table.rows.len() + batch.num_rows() > rows {
            return Err(unreadable(&format!(
                "it holds more than the {rows} rows that it claims"
            )));
        }
        take(&batch, &mut table.rows, &mut left)?;
    }
    Ok(table)
}

/// Takes the rows of a batch: text as it is, numbers as text, lists of numbers as `[1,2]`. The texts of
/// all batches have at most `left` bytes, which are counted down.
fn take(
    batch: &RecordBatch,
    rows: &mut Vec<HashMap<&'static str, String>>,
    left: &mut usize,
) -> Result<(), ManifestError> {
    let first = rows.len();
    rows.resize_with(first + batch.num_rows(), HashMap::new);
    for (field, column) in batch.schema().fields().iter().zip(batch.columns()) {
        let Some(name) = known(field.name()) else {
            continue;
        };
        let other = || ManifestError::Unreadable(format!("{name} has type {}", field.data_type()));
        for row in 0..batch.num_rows() {
            if column.is_null(row) {
                continue;
            }
            let numbers = |list: arrow_array::ArrayRef| -> Result<String, ManifestError> {
                let values = list.as_primitive_opt::<arrow_array::types::Float64Type>();
                let values = values.ok_or_else(other)?;
                if arrow_array::Array::null_count(values) > 0 {
                    let text = format!("row {}: a number of {name} is missing", first + row + 1);
                    return Err(ManifestError::Unreadable(text));
                }
                Ok(serde_json::to_string(&values.values()[..]).unwrap_or_default())
            };
            let text = match field.data_type() {
                Type::Utf8 => column.as_string::<i32>().value(row).to_owned(),
                Type::LargeUtf8 => column.as_string::<i64>().value(row).to_owned(),
                Type::Utf8View => column.as_string_view().value(row).to_owned(),
                Type::Int64 => {
                    let values = column.as_primitive::<arrow_array::types::Int64Type>();
                    values.value(row).to_string()
                }
                Type::UInt64 => {
                    let values = column.as_primitive::<arrow_array::types::UInt64Type>();
                    values.value(row).to_string()
                }
                Type::Float64 => {
                    let values = column.as_primitive::<arrow_array::types::Float64Type>();
                    values.value(row).to_string()
                }
                Type::List(_) => numbers(column.as_list::<i32>().value(row))?,
                Type::LargeList(_) => numbers(column.as_list::<i64>().value(row))?,
                Type::FixedSizeList(_, _) => numbers(column.as_fixed_size_list().value(row))?,
                _ => return Err(other()),
            };
            *left = left
                .checked_sub(text.len())
                .ok_or(ManifestError::TooLarge)?;
            rows[first + row].insert(name, text);
        }
    }
    Ok(())
}
