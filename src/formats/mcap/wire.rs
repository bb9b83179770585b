//! Numbers and texts in the encodings of MCAP, ROS 1 and ROS 2.
//!
//! All are little endian here, with the length of a text or list in 4 bytes before it. ROS 2's encoding,
//! CDR, places each number at a multiple of its size.

use crate::formats::error::{FileKind, FormatError};

pub(super) const KIND: FileKind = FileKind::Mcap;

/// Where numbers lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Alignment {
    /// One after the other: MCAP and ROS 1.
    Packed,
    /// At multiples of their size, after 4 bytes that name the byte order: ROS 2.
    Cdr,
}

/// Bytes that are read from the front.
pub(super) struct Wire<'a> {
    bytes: &'a [u8],
    at: usize,
    alignment: Alignment,
}

impl<'a> Wire<'a> {
    pub(super) fn packed(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            at: 0,
            alignment: Alignment::Packed,
        }
    }

    /// A message of ROS.
    ///
    /// # Errors
    /// `Unsupported` for CDR in big endian or with parameters.
    pub(super) fn message(bytes: &'a [u8], alignment: Alignment) -> Result<Self, FormatError> {
        const LITTLE_ENDIAN: [u8; 2] = [0, 1];
        let mut wire = Self::packed(bytes);
        if alignment == Alignment::Cdr {
            let kind = wire.array::<2>()?;
            if kind != LITTLE_ENDIAN {
                return Err(KIND.unsupported(format!("a message has the encoding {kind:?} of CDR")));
            }
            let _options = wire.array::<2>()?;
            // Places count from here.
            wire = Self::packed(wire.rest());
        }
        Ok(Self { alignment, ..wire })
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], FormatError> {
        let left = &self.bytes[self.at..];
        let taken = left.get(..count).ok_or_else(|| {
            let left = left.len();
            KIND.malformed(format!(
                "a record has {left} bytes where {count} are declared"
            ))
        })?;
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], FormatError> {
        if self.alignment == Alignment::Cdr {
            let padding = self.at.next_multiple_of(N) - self.at;
            self.take(padding)?;
        }
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    pub(super) fn u8(&mut self) -> Result<u8, FormatError> {
        self.array().map(u8::from_le_bytes)
    }

    pub(super) fn u16(&mut self) -> Result<u16, FormatError> {
        self.array().map(u16::from_le_bytes)
    }

    pub(super) fn u32(&mut self) -> Result<u32, FormatError> {
        self.array().map(u32::from_le_bytes)
    }

    pub(super) fn u64(&mut self) -> Result<u64, FormatError> {
        self.array().map(u64::from_le_bytes)
    }

    /// A list of bytes.
    pub(super) fn bytes(&mut self) -> Result<&'a [u8], FormatError> {
        let count = self.u32()? as usize;
        self.take(count)
    }

    /// A text. That of CDR ends with a zero.
    pub(super) fn text(&mut self) -> Result<&'a str, FormatError> {
        let bytes = self.bytes()?;
        let bytes = match bytes {
            [text @ .., 0] if self.alignment == Alignment::Cdr => text,
            _ => bytes,
        };
        std::str::from_utf8(bytes).map_err(|_| KIND.malformed("a name is not UTF-8"))
    }

    /// What has not been read.
    pub(super) fn rest(&self) -> &'a [u8] {
        &self.bytes[self.at..]
    }
}
