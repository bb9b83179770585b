//! Limits of a Parquet file's footer, checked before a reader allocates what it claims.
//!
//! ```text
//! footer = FileMetaData in Thrift's compact protocol, its length (32 bits, little-endian), PAR1
//! ```

use super::thrift::{Found, Input};

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
    let walked = Input(&body[from..]).walk(&mut Vec::new(), &mut |path, found| match found {
        Found::List(count) if path == [SCHEMA] => elements = count,
        Found::Number(count) if path == CHILDREN => children = children.max(count),
        _ => {}
    });
    walked.ok_or_else(damaged)?;
    if usize::try_from(children).is_ok_and(|children| children > elements) {
        return Err(format!(
            "a column claims {children} others, the schema has {elements}"
        ));
    }
    Ok(())
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
