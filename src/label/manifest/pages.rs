//! Limits of a Parquet file's pages, checked before a reader allocates what their headers claim.
//!
//! ```text
//! file = pages, footer      page = header, compressed bytes      header = a struct of Thrift's compact protocol
//! ```
//!
//! A reader of Parquet allocates by the numbers in a page's header. Some tens of bytes can claim 2 GiB or a
//! billion values. [`CheckedPages`] reads each header first, and refuses what a manifest never needs.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use bytes::Bytes;
use parquet::errors::{ParquetError, Result};
use parquet::file::reader::{ChunkReader, Length};

use super::thrift::Input;

/// Uncompressed bytes that any page may have.
const PAGE_BYTES: u64 = 8 << 20;
/// Uncompressed bytes that a larger page may have for each compressed byte.
const PAGE_RATIO: u64 = 256;
/// Most structs within each other in a header.
const MAX_DEPTH: usize = 4;

/// The bytes of a file, whose page headers are checked when they are read.
pub(super) struct CheckedPages {
    bytes: Bytes,
    /// Values that the data pages may still declare.
    values_left: AtomicU64,
}

impl CheckedPages {
    /// All data pages together may declare `values`.
    pub(super) fn new(bytes: Bytes, values: u64) -> Self {
        let values_left = AtomicU64::new(values);
        Self { bytes, values_left }
    }

    fn check(&self, header: &Header) -> Result<()> {
        let most = PAGE_BYTES.max(header.compressed.saturating_mul(PAGE_RATIO));
        if header.uncompressed > most {
            let (is, from) = (header.uncompressed, header.compressed);
            return refused(format!(
                "a page claims {is} bytes, compressed to {from}: at most {most} are read"
            ));
        }
        match header.kind {
            Kind::Dictionary { values } if values > header.uncompressed => {
                let bytes = header.uncompressed;
                refused(format!(
                    "a dictionary of {bytes} bytes claims {values} values"
                ))
            }
            Kind::Data { values, encoding } => {
                if let Some(name) = refused_encoding(encoding) {
                    return refused(format!(
                        "a column has the encoding {name}: write it plain or with a dictionary"
                    ));
                }
                let left = self
                    .values_left
                    .fetch_update(Relaxed, Relaxed, |left| left.checked_sub(values));
                if left.is_err() {
                    return refused("its pages claim more values than its rows have".to_owned());
                }
                Ok(())
            }
            Kind::Dictionary { .. } | Kind::Index => Ok(()),
        }
    }
}

impl Length for CheckedPages {
    fn len(&self) -> u64 {
        self.bytes.len() as u64
    }
}

impl ChunkReader for CheckedPages {
    type T = <Bytes as ChunkReader>::T;

    /// The reader of pages calls this at the start of each page's header, and nowhere else.
    fn get_read(&self, start: u64) -> Result<Self::T> {
        let from = usize::try_from(start).ok();
        let bytes = from.and_then(|from| self.bytes.get(from..));
        let header = bytes.and_then(Header::parse);
        let header = header.ok_or_else(|| {
            ParquetError::General(
                "the header of a page is damaged or of an unknown kind".to_owned(),
            )
        })?;
        self.check(&header)?;
        self.bytes.get_read(start)
    }

    fn get_bytes(&self, start: u64, length: usize) -> Result<Bytes> {
        self.bytes.get_bytes(start, length)
    }
}

fn refused<T>(why: String) -> Result<T> {
    Err(ParquetError::General(why))
}

/// What a page is: field 1 of its header, and the struct of that kind.
#[derive(Debug, PartialEq)]
enum Kind {
    Data { values: u64, encoding: u64 },
    Index,
    Dictionary { values: u64 },
}

/// The header of a page (`PageHeader` of Parquet's format).
#[derive(Debug, PartialEq)]
struct Header {
    uncompressed: u64,
    compressed: u64,
    kind: Kind,
}

impl Header {
    /// Reads a header. `None` where it is cut, or not as every writer writes it: fields in ascending order,
    /// each once, without lists.
    fn parse(bytes: &[u8]) -> Option<Self> {
        let mut numbers = [[None; 9]; 9];
        let mut input = Input(bytes);
        read_struct(&mut input, 0, 0, &mut numbers)?;
        let number = |parent: usize, field: usize| numbers[parent][field];
        let kind = match number(0, 1)? {
            0 => Kind::Data {
                values: number(5, 1)?,
                encoding: number(5, 2)?,
            },
            1 => Kind::Index,
            2 => Kind::Dictionary {
                values: number(7, 1)?,
            },
            3 => Kind::Data {
                values: number(8, 1)?,
                encoding: number(8, 4)?,
            },
            _ => return None,
        };
        Some(Self {
            uncompressed: number(0, 2)?,
            compressed: number(0, 3)?,
            kind,
        })
    }
}

/// The name of an encoding that is refused, such as those by differences: their own headers claim counts,
/// inside of the compressed bytes. None for PLAIN, PLAIN_DICTIONARY, RLE and RLE_DICTIONARY.
fn refused_encoding(encoding: u64) -> Option<String> {
    match encoding {
        0 | 2 | 3 | 8 => None,
        5 => Some("DELTA_BINARY_PACKED".to_owned()),
        6 => Some("DELTA_LENGTH_BYTE_ARRAY".to_owned()),
        7 => Some("DELTA_BYTE_ARRAY".to_owned()),
        9 => Some("BYTE_STREAM_SPLIT".to_owned()),
        other => Some(format!("number {other}")),
    }
}

/// The structs in the struct of a page's kind. A reader skips them.
const STATISTICS: usize = usize::MAX;

/// Whether a field of a header's structs has the type that the format gives it. A reader takes that type for
/// granted, and would read the rest from the wrong byte on.
fn is_of_its_type(parent: usize, id: usize, stored: u8) -> bool {
    match (parent, id) {
        (STATISTICS, _) => true,
        (0, 1..=4) | (5, 1..=4) | (7, 1..=2) | (8, 1..=6) => stored == 5,
        (7, 3) | (8, 7) => stored == 1 || stored == 2,
        (0, 5..=8) | (5, 5) | (8, 8) => stored == 12,
        _ => false,
    }
}

/// Reads the fields of a struct up to its end. Numbers that are not negative go to
/// `numbers[parent][id]`, where the array has that place; those of the structs in it to `numbers[id]`.
fn read_struct(
    input: &mut Input<'_>,
    parent: usize,
    depth: usize,
    numbers: &mut [[Option<u64>; 9]; 9],
) -> Option<()> {
    let mut id = 0;
    loop {
        let field = input.byte()?;
        if field == 0 {
            return Some(());
        }
        // The step of the ids. 0 would let an id follow that may be lower.
        let step = usize::from(field >> 4);
        id += (step > 0).then_some(step)?;
        if !is_of_its_type(parent, id, field & 15) {
            return None;
        }
        match field & 15 {
            // True and false.
            1 | 2 => {}
            3 => drop(input.byte()?),
            // 16, 32 and 64 bits, in zigzag form.
            4..=6 => {
                let zigzag = input.varint()?;
                if let Some(place) = numbers.get_mut(parent).and_then(|row| row.get_mut(id)) {
                    *place = (zigzag & 1 == 0).then_some(zigzag >> 1);
                }
            }
            7 => input.skip(8)?,
            8 => {
                let length = input.varint()?;
                input.skip(usize::try_from(length).ok()?)?;
            }
            // A struct in a struct of the header holds statistics: its numbers have no place.
            12 if depth < MAX_DEPTH => {
                let child = if depth == 0 { id } else { STATISTICS };
                read_struct(input, child, depth + 1, numbers)?;
            }
            _ => return None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A data page of 100 bytes, compressed to 60, with 3 values, plain, and statistics.
    const DATA: [u8; 26] = [
        0x15, 0, 0x15, 200, 1, 0x15, 120, 0x2c, 0x15, 6, 0x15, 0, 0x15, 6, 0x15, 6, 0x1c, 0x18, 1,
        b'z', 0x26, 2, 0, 0, 0, 0xff,
    ];

    #[test]
    fn a_header_is_read_to_its_end() {
        let kind = Kind::Data {
            values: 3,
            encoding: 0,
        };
        let header = Header {
            uncompressed: 100,
            compressed: 60,
            kind,
        };
        assert_eq!(Header::parse(&DATA), Some(header));
        for length in 0..DATA.len() - 1 {
            assert_eq!(Header::parse(&DATA[..length]), None, "{length}");
        }
    }

    #[test]
    fn a_field_that_comes_twice_is_negative_or_of_another_type_is_refused() {
        // The long form of an id could name field 2 again.
        let mut twice = DATA.to_vec();
        twice.splice(24..24, [0x05, 4, 200, 1]);
        assert_eq!(Header::parse(&twice), None);
        let mut negative = DATA;
        negative[6] = 121;
        assert_eq!(Header::parse(&negative), None);
        // The compressed size as a number of 64 bits, and its bytes as those of a text.
        for other in [0x16, 0x18] {
            let mut typed = DATA;
            typed[5] = other;
            assert_eq!(Header::parse(&typed), None);
        }
    }

    #[test]
    fn pages_claim_no_more_than_they_can_hold() {
        let file = CheckedPages::new(Bytes::new(), 10);
        let page = |uncompressed, compressed, kind| Header {
            uncompressed,
            compressed,
            kind,
        };
        let data = |values| Kind::Data {
            values,
            encoding: 0,
        };
        file.check(&page(8 << 20, 1, data(6))).expect("8 MiB");
        file.check(&page(1 << 30, 4 << 20, data(4)))
            .expect("a ratio of 256");
        for (header, said) in [
            (page(1 << 30, 1 << 20, data(0)), "claims 1073741824 bytes"),
            (page(8, 8, data(1)), "more values than its rows"),
            (
                page(8, 8, Kind::Dictionary { values: 9 }),
                "claims 9 values",
            ),
        ] {
            let error = file.check(&header).expect_err(said).to_string();
            assert!(error.contains(said), "{error}");
        }
        let delta = Kind::Data {
            values: 1,
            encoding: 7,
        };
        let error = file.check(&page(8, 8, delta)).expect_err("differences");
        assert!(error.to_string().contains("DELTA_BYTE_ARRAY"), "{error}");
    }
}
