//! A binary envelope: magic, version, body and checksum.
//!
//! ```text
//! magic 8 | version u32 | body | FNV-1a of all before it, u64
//! ```
//!
//! All numbers are little-endian.

/// Bytes before the body.
const HEADER: usize = 8 + 4;

/// The expected envelope of a format.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Envelope {
    pub(crate) magic: [u8; 8],
    pub(crate) version: u32,
}

/// The reason why the bytes of a snapshot or of a motion field were rejected.
///
/// The bytes consist of a magic number of 8 bytes, a format version, a body and a checksum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EnvelopeError {
    /// The bytes do not begin with the format's magic number: they are of another format, or fewer
    /// than 8.
    #[error("the bytes are something else")]
    Magic,
    /// Written as another version of the format.
    #[error("written as version {version}, this program reads version {expected}")]
    Version {
        /// The version in the bytes.
        version: u32,
        /// The version that this program reads.
        expected: u32,
    },
    /// The checksum does not match, bytes are missing or left over, or a value is invalid.
    #[error("the bytes are damaged")]
    Damaged,
}

impl Envelope {
    /// The envelope's header, to be extended by the body and [closed](Self::close).
    pub(crate) fn begin(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend(self.magic);
        bytes.extend(self.version.to_le_bytes());
        bytes
    }

    /// The bytes with their checksum appended.
    pub(crate) fn close(&self, mut bytes: Vec<u8>) -> Vec<u8> {
        let checksum = Hash::default().of(&bytes);
        bytes.extend(checksum.to_le_bytes());
        bytes
    }

    /// Checks the envelope and returns its body; allocates nothing.
    ///
    /// # Errors
    /// [`EnvelopeError`] if the bytes are of another format or version, truncated or altered.
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
        let (sound, checksum) = bytes.split_last_chunk().ok_or(EnvelopeError::Damaged)?;
        if *checksum != Hash::default().of(sound).to_le_bytes() {
            return Err(EnvelopeError::Damaged);
        }
        // The checksum matches, so the header fields read above are valid, too.
        rest.0 = sound.get(HEADER..).ok_or(EnvelopeError::Damaged)?;
        Ok(rest)
    }
}

/// The unread bytes of a body.
pub(crate) struct Body<'a>(&'a [u8]);

impl Body<'_> {
    pub(crate) fn take<const N: usize>(&mut self) -> Result<[u8; N], EnvelopeError> {
        let (taken, rest) = self.0.split_first_chunk().ok_or(EnvelopeError::Damaged)?;
        self.0 = rest;
        Ok(*taken)
    }

    /// Checks that all bytes have been read.
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

    /// Reads the number of items of `bytes` bytes each that follow; an error if the remaining bytes
    /// cannot hold them.
    pub(crate) fn count_of(&mut self, bytes: usize) -> Result<usize, EnvelopeError> {
        let count = self.count()?;
        match count.checked_mul(bytes) {
            Some(needed) if needed <= self.0.len() => Ok(count),
            _ => Err(EnvelopeError::Damaged),
        }
    }

    /// Number of unread bytes.
    pub(crate) fn bytes_left(&self) -> usize {
        self.0.len()
    }
}

/// FNV-1a over 64 bits. Any single altered byte changes the hash.
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
