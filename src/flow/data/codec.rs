//! Numbers as bytes that can be trusted: a magic, a version, a body, a checksum.
//!
//! ```text
//! magic 8 | version u32 | body | FNV-1a of all before it, u64
//! ```
//!
//! Little-endian. Knows neither what the numbers mean nor any files.

use crate::flow::field::{LAID_OUT, Parameters};

/// Bytes before the body.
const HEADER: usize = 8 + 4;
/// Bytes of a network's parameters.
pub(crate) const PARAMETERS_BYTES: usize = LAID_OUT * size_of::<f32>();

/// What the bytes should be.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Envelope {
    pub(crate) magic: [u8; 8],
    pub(crate) version: u32,
    /// Bytes of the body, where there are always as many.
    pub(crate) body: Option<usize>,
}

/// Why bytes were refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EnvelopeError {
    /// The bytes are something else.
    #[error("the bytes are something else")]
    Magic,
    /// Written by another version.
    #[error("written as version {version}, this program reads version {expected}")]
    Version {
        /// The version that the bytes name.
        version: u32,
        /// The version that is read.
        expected: u32,
    },
    /// Bytes are missing, or there are too many.
    #[error("{bytes} bytes, {expected} are expected")]
    Length {
        /// Bytes there.
        bytes: usize,
        /// Bytes expected.
        expected: usize,
    },
    /// The checksum is wrong, bytes are missing or left over, or a number is none.
    #[error("the bytes are damaged")]
    Damaged,
}

impl Envelope {
    /// Bytes with this seal, to be filled and [closed](Self::close).
    pub(crate) fn begin(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend(self.magic);
        bytes.extend(self.version.to_le_bytes());
        bytes
    }

    /// The bytes with their checksum.
    pub(crate) fn close(&self, mut bytes: Vec<u8>) -> Vec<u8> {
        let checksum = Hash::default().of(&bytes);
        bytes.extend(checksum.to_le_bytes());
        bytes
    }

    /// The body of sealed bytes; nothing is allocated.
    ///
    /// # Errors
    /// [`EnvelopeError`] where they are something else, of another version, torn or altered.
    pub(crate) fn open<'a>(&self, bytes: &'a [u8]) -> Result<Body<'a>, EnvelopeError> {
        if !bytes.starts_with(&self.magic) {
            return Err(EnvelopeError::Magic);
        }
        let mut rest = Body(&bytes[self.magic.len()..]);
        let version = u32::from_le_bytes(rest.take()?);
        if version != self.version {
            return Err(EnvelopeError::Version {
                version,
                expected: self.version,
            });
        }
        let whole = |body: usize| HEADER + body + size_of::<u64>();
        if let Some(expected) = self.body.map(whole)
            && bytes.len() != expected
        {
            return Err(EnvelopeError::Length {
                bytes: bytes.len(),
                expected,
            });
        }
        let (sound, checksum) = bytes.split_last_chunk().ok_or(EnvelopeError::Damaged)?;
        if *checksum != Hash::default().of(sound).to_le_bytes() {
            return Err(EnvelopeError::Damaged);
        }
        // The checksum holds, so that what was read of the header is sound, too.
        rest.0 = sound.get(HEADER..).ok_or(EnvelopeError::Damaged)?;
        Ok(rest)
    }
}

/// A body's bytes that are left to read.
pub(crate) struct Body<'a>(&'a [u8]);

impl Body<'_> {
    pub(crate) fn take<const N: usize>(&mut self) -> Result<[u8; N], EnvelopeError> {
        let (taken, rest) = self.0.split_first_chunk().ok_or(EnvelopeError::Damaged)?;
        self.0 = rest;
        Ok(*taken)
    }

    /// That all has been read.
    pub(crate) fn end(&self) -> Result<(), EnvelopeError> {
        if self.0.is_empty() {
            Ok(())
        } else {
            Err(EnvelopeError::Damaged)
        }
    }

    pub(crate) fn number(&mut self) -> Result<u64, EnvelopeError> {
        self.take().map(u64::from_le_bytes)
    }

    pub(crate) fn float(&mut self) -> Result<f64, EnvelopeError> {
        self.number().map(f64::from_bits)
    }

    pub(crate) fn count(&mut self) -> Result<usize, EnvelopeError> {
        usize::try_from(self.number()?).map_err(|_| EnvelopeError::Damaged)
    }

    pub(crate) fn single(&mut self) -> Result<f32, EnvelopeError> {
        self.take().map(f32::from_le_bytes)
    }

    /// How many things of `bytes` each follow: never more than there are bytes for.
    pub(crate) fn count_of(&mut self, bytes: usize) -> Result<usize, EnvelopeError> {
        let count = self.count()?;
        match count.checked_mul(bytes) {
            Some(needed) if needed <= self.0.len() => Ok(count),
            _ => Err(EnvelopeError::Damaged),
        }
    }

    pub(crate) fn parameters(&mut self) -> Result<Parameters, EnvelopeError> {
        if self.0.len() < PARAMETERS_BYTES {
            return Err(EnvelopeError::Damaged);
        }
        let mut parameters = Parameters::zeros();
        for value in parameters.as_mut_slice() {
            *value = f32::from_le_bytes(self.take()?);
        }
        Ok(parameters)
    }
}

/// Appends the parameters.
pub(crate) fn put_parameters(bytes: &mut Vec<u8>, parameters: &Parameters) {
    let floats = parameters.as_slice().iter();
    bytes.extend(floats.flat_map(|value| value.to_le_bytes()));
}

/// FNV-1a over 64 bits: a single altered byte always shows.
pub(crate) struct Hash(pub(crate) u64);

impl Default for Hash {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Hash {
    pub(crate) fn word(&mut self, word: u64) {
        self.0 = (self.0 ^ word).wrapping_mul(0x0000_0100_0000_01b3);
    }

    pub(crate) fn of(mut self, bytes: &[u8]) -> u64 {
        bytes.iter().for_each(|&byte| self.word(u64::from(byte)));
        self.0
    }
}
