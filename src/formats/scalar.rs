//! Numbers in binary files: width, signedness and byte order, decoded to float64.
//!
//! Shared by all binary formats. Independent of the meaning of the numbers.

use std::io::{Read, Write};

use half::f16;

use super::error::{FileKind, FormatError};

/// The type of a stored number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F16,
    F32,
    F64,
}

/// The order of a stored number's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ByteOrder {
    Little,
    Big,
}

impl Scalar {
    /// Width in bytes.
    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 | Self::F16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    pub(super) fn is_float(self) -> bool {
        matches!(self, Self::F16 | Self::F32 | Self::F64)
    }

    /// Decodes the number at the start of `bytes`; `None` where there are too few bytes.
    pub(super) fn decode(self, bytes: &[u8], order: ByteOrder) -> Option<f64> {
        fn first<const N: usize>(bytes: &[u8], order: ByteOrder) -> Option<[u8; N]> {
            let mut raw = *bytes.first_chunk::<N>()?;
            if order == ByteOrder::Big {
                raw.reverse();
            }
            Some(raw)
        }
        Some(match self {
            Self::I8 => f64::from(i8::from_le_bytes(first(bytes, order)?)),
            Self::U8 => f64::from(u8::from_le_bytes(first(bytes, order)?)),
            Self::I16 => f64::from(i16::from_le_bytes(first(bytes, order)?)),
            Self::U16 => f64::from(u16::from_le_bytes(first(bytes, order)?)),
            Self::I32 => f64::from(i32::from_le_bytes(first(bytes, order)?)),
            Self::U32 => f64::from(u32::from_le_bytes(first(bytes, order)?)),
            Self::I64 => i64::from_le_bytes(first(bytes, order)?) as f64,
            Self::U64 => u64::from_le_bytes(first(bytes, order)?) as f64,
            Self::F16 => f16::from_le_bytes(first(bytes, order)?).to_f64(),
            Self::F32 => f64::from(f32::from_le_bytes(first(bytes, order)?)),
            Self::F64 => f64::from_le_bytes(first(bytes, order)?),
        })
    }

    /// Streams `count` numbers from `reader` to `take` (index, value) without storing them.
    pub(super) fn each<R: Read + ?Sized>(
        self,
        order: ByteOrder,
        count: usize,
        kind: FileKind,
        reader: &mut R,
        mut take: impl FnMut(usize, f64) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        let size = self.size();
        let mut chunk = [0_u8; 8192];
        let numbers_per_chunk = chunk.len() / size;
        let mut index = 0;
        while index < count {
            let numbers = numbers_per_chunk.min(count - index);
            let filled = &mut chunk[..numbers * size];
            reader.read_exact(filled).map_err(|error| {
                kind.malformed(format!(
                    "the data ends or breaks after {index} numbers: {error}"
                ))
            })?;
            for raw in filled.chunks_exact(size) {
                if let Some(value) = self.decode(raw, order) {
                    take(index, value)?;
                }
                index += 1;
            }
        }
        Ok(())
    }
}

/// Writes float32, little endian.
pub(super) fn write_floats(out: &mut dyn Write, values: &[f32]) -> Result<(), FormatError> {
    const PER_CHUNK: usize = 2048;
    let mut bytes = Vec::with_capacity(PER_CHUNK * 4);
    for chunk in values.chunks(PER_CHUNK) {
        bytes.clear();
        bytes.extend(chunk.iter().flat_map(|value| value.to_le_bytes()));
        out.write_all(&bytes)?;
    }
    Ok(())
}
