//! Limits of a Parquet file's footer, checked before a reader allocates what it claims.
//!
//! ```text
//! footer = FileMetaData in Thrift's compact protocol, its length (32 bits, little-endian), PAR1
//! ```

use super::thrift::{BINARY, DOUBLE, FALSE, Found, I8, I16, I32, I64, Input, LIST, STRUCT, TRUE};

/// Most bytes of a footer.
const MAX_BYTES: usize = 8 << 20;
/// What follows the metadata: their length, and the magic bytes.
const TAIL_BYTES: usize = 8;
/// Of `FileMetaData`: the list of the schema's elements; of such an element: the number of its children.
const SCHEMA: i64 = 2;
const CHILDREN: [i64; 2] = [SCHEMA, 5];

/// Checks the footer of a file. A list has no more elements than bytes follow, and an element of the schema
/// no more children than there are elements.
///
/// # Errors
/// Why the file is refused, as text.
pub(super) fn check(file: &[u8]) -> Result<(), String> {
    let damaged = || "the footer is damaged".to_owned();
    let (body, tail) = file.split_last_chunk::<TAIL_BYTES>().ok_or_else(damaged)?;
    let length = u32::from_le_bytes([tail[0], tail[1], tail[2], tail[3]]) as usize;
    if length > MAX_BYTES {
        return Err(format!(
            "the footer has {length} bytes: at most {MAX_BYTES} are read"
        ));
    }
    let from = body.len().checked_sub(length).ok_or_else(damaged)?;
    let (mut elements, mut children) = (0, 0);
    let walked = Input(&body[from..]).walk(&mut Vec::new(), &mut |path, found| {
        match found {
            Found::List(count, _) if path == [SCHEMA] => elements = count,
            Found::Number(count) if path == CHILDREN => children = children.max(count),
            _ => {}
        }
        is_of_its_type(path, found)
    });
    walked.ok_or_else(damaged)?;
    if usize::try_from(children).is_ok_and(|children| children > elements) {
        return Err(format!(
            "a column claims {children} others, the schema has {elements}"
        ));
    }
    Ok(())
}

/// Whether a field has the type that the format gives it. A reader takes that type for granted, and would
/// read the rest from the wrong byte on. Fields that the format does not have are skipped by their type.
fn is_of_its_type(path: &[i64], found: Found) -> bool {
    let Some((kind, elements)) = type_of(path) else {
        return true;
    };
    match found {
        Found::Field(TRUE | FALSE) => kind == TRUE,
        Found::Field(stored) => kind == stored,
        Found::List(_, stored) => elements == stored,
        Found::Number(_) => true,
    }
}

/// The type of a field by the ids from `FileMetaData` on, and that of its elements if it is a list.
fn type_of(path: &[i64]) -> Option<(u8, u8)> {
    let one = |kind| Some((kind, 0));
    let list = |kind| Some((LIST, kind));
    let (&id, around) = path.split_last()?;
    match (around, id) {
        // FileMetaData.
        ([], 1) => one(I32),
        ([], 2 | 4 | 5 | 7) => list(STRUCT),
        ([], 3) => one(I64),
        ([], 6 | 9) => one(BINARY),
        ([], 8) => one(STRUCT),
        // SchemaElement, its logical type and the parts of that.
        ([2], 1..=3 | 5..=9) => one(I32),
        ([2], 4) => one(BINARY),
        ([2], 10) => one(STRUCT),
        ([2, 10], 1..=18) => one(STRUCT),
        ([2, 10, 5], 1 | 2) => one(I32),
        ([2, 10, 7 | 8], 1) => one(TRUE),
        ([2, 10, 7 | 8], 2) | ([2, 10, 7 | 8, 2], 1..=3) => one(STRUCT),
        ([2, 10, 10 | 16], 1) => one(I8),
        ([2, 10, 10], 2) => one(TRUE),
        ([2, 10, 17 | 18], 1) => one(BINARY),
        ([2, 10, 18], 2) => one(I32),
        // RowGroup and its order.
        ([4], 1 | 4) => list(STRUCT),
        ([4], 2 | 3 | 5 | 6) => one(I64),
        ([4], 7) => one(I16),
        ([4, 4], 1) => one(I32),
        ([4, 4], 2 | 3) => one(TRUE),
        // ColumnChunk, and its ColumnMetaData.
        ([4, 1], 1 | 9) => one(BINARY),
        ([4, 1], 2 | 4 | 6) => one(I64),
        ([4, 1], 3 | 8) => one(STRUCT),
        ([4, 1], 5 | 7) => one(I32),
        ([4, 1, 3], 1 | 4 | 15) => one(I32),
        ([4, 1, 3], 2) => list(I32),
        ([4, 1, 3], 3) => list(BINARY),
        ([4, 1, 3], 5..=7 | 9..=11 | 14) => one(I64),
        ([4, 1, 3], 8 | 13) => list(STRUCT),
        ([4, 1, 3], 12 | 16 | 17) => one(STRUCT),
        // KeyValue, Statistics, PageEncodingStats, SizeStatistics, GeospatialStatistics.
        ([5] | [4, 1, 3, 8], 1 | 2) => one(BINARY),
        ([4, 1, 3, 12], 1 | 2 | 5 | 6) => one(BINARY),
        ([4, 1, 3, 12], 3 | 4) => one(I64),
        ([4, 1, 3, 12], 7 | 8) => one(TRUE),
        ([4, 1, 3, 13], 1..=3) => one(I32),
        ([4, 1, 3, 16], 1) => one(I64),
        ([4, 1, 3, 16], 2 | 3) => list(I64),
        ([4, 1, 3, 17], 1) => one(STRUCT),
        ([4, 1, 3, 17], 2) => list(I32),
        ([4, 1, 3, 17, 1], 1..=8) => one(DOUBLE),
        // ColumnOrder.
        ([7], _) => one(STRUCT),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(metadata: &[u8]) -> Vec<u8> {
        let length = (metadata.len() as u32).to_le_bytes();
        [b"PAR1", metadata, &length, b"PAR1"].concat()
    }

    /// A schema of a root with `children` and one column, and three rows.
    fn metadata(children: u8) -> Vec<u8> {
        let root = [0x55, children, 0];
        let column = [0x15, 12, 0x38, 1, b'a', 0];
        [&[0x15, 4, 0x19, 0x2c][..], &root, &column, &[0x16, 6, 0]].concat()
    }

    #[test]
    fn a_schema_claims_no_more_columns_than_it_has() {
        check(&file(&metadata(2))).expect("one column");
        let error = check(&file(&metadata(126))).expect_err("63 columns");
        assert!(
            error.contains("claims 63 others, the schema has 2"),
            "{error}"
        );
    }

    #[test]
    fn a_field_of_another_type_than_the_formats_is_refused() {
        let whole = metadata(2);
        // The number of children as a number of 64 bits, and the name of a column as a struct.
        for (place, other) in [(4, 0x56), (9, 0x3c)] {
            let mut typed = whole.clone();
            typed[place] = other;
            assert!(check(&file(&typed)).is_err(), "{place}");
        }
        // A field that the format does not have, by the long form of its id.
        let unknown = [&whole[..whole.len() - 1], &[0x08, 0xc8, 0x01, 1, b'x', 0]].concat();
        check(&file(&unknown)).expect("it is skipped");
    }

    #[test]
    fn lists_claim_no_more_than_the_bytes_that_follow_and_cut_footers_are_damaged() {
        let whole = metadata(2);
        for length in 0..whole.len() {
            assert!(check(&file(&whole[..length])).is_err(), "{length}");
        }
        let mut many = whole.clone();
        // The list of the schema's elements in its long form: 2^21 of them.
        many.splice(3..4, [0xfc, 0x80, 0x80, 0x80, 0x01]);
        assert!(check(&file(&many)).is_err());
        // Structs within structs.
        let deep = [[0x1c].repeat(1000), [0].repeat(1001)].concat();
        assert!(check(&file(&deep)).is_err());
        let mut long = file(&whole);
        let end = long.len();
        long[end - 8..end - 4].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(check(&long).is_err());
        assert!(check(b"PAR1").is_err());
    }
}
