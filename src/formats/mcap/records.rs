//! The records of a recording: an operation code, a length of 8 bytes, and that many bytes.

use std::io::Read;

use super::wire::KIND;
use crate::formats::error::FormatError;

/// The first and the last bytes.
pub(in crate::formats) const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// The largest record that is held in memory, bytes.
const MAX_RECORD: u64 = 1 << 30;

/// Bytes of an operation code and a length.
const HEAD: usize = 9;

pub(super) const HEADER: u8 = 0x01;
pub(super) const FOOTER: u8 = 0x02;
pub(super) const SCHEMA: u8 = 0x03;
pub(super) const CHANNEL: u8 = 0x04;
pub(super) const MESSAGE: u8 = 0x05;
pub(super) const CHUNK: u8 = 0x06;
pub(super) const MESSAGE_INDEX: u8 = 0x07;
pub(super) const CHUNK_INDEX: u8 = 0x08;
pub(super) const STATISTICS: u8 = 0x0b;
pub(super) const DATA_END: u8 = 0x0f;

/// The records that are read, with their contents.
#[derive(Clone, Copy)]
pub(super) enum Record<'a> {
    Schema(&'a [u8]),
    Channel(&'a [u8]),
    Message(&'a [u8]),
    Chunk(&'a [u8]),
}

impl<'a> Record<'a> {
    fn of(code: u8, content: &'a [u8]) -> Option<Self> {
        match code {
            SCHEMA => Some(Self::Schema(content)),
            CHANNEL => Some(Self::Channel(content)),
            MESSAGE => Some(Self::Message(content)),
            CHUNK => Some(Self::Chunk(content)),
            _ => None,
        }
    }
}

/// The records of a file, up to the end of its data.
pub(super) struct Records<R> {
    file: R,
    content: Vec<u8>,
}

impl<R: Read> Records<R> {
    /// # Errors
    /// `Malformed` if the file does not begin as a recording.
    pub(super) fn open(mut file: R) -> Result<Self, FormatError> {
        let mut magic = [0; MAGIC.len()];
        let read = file.read_exact(&mut magic);
        if read.is_err() || magic != MAGIC {
            return Err(KIND.malformed("it does not begin as a recording"));
        }
        Ok(Self {
            file,
            content: Vec::new(),
        })
    }

    /// The next record of a kind that is read. None at the end of the data.
    ///
    /// # Errors
    /// `Malformed` if the file ends before, `TooLarge` for a record over 1 GiB.
    pub(super) fn read_next(&mut self) -> Result<Option<Record<'_>>, FormatError> {
        loop {
            let mut head = [0; HEAD];
            self.file.read_exact(&mut head).map_err(|_| cut_off())?;
            let (code, length) = parse(&head);
            if matches!(code, DATA_END | FOOTER) {
                return Ok(None);
            }
            let mut content = self.file.by_ref().take(length);
            if !matches!(code, SCHEMA | CHANNEL | MESSAGE | CHUNK) {
                let skipped = std::io::copy(&mut content, &mut std::io::sink());
                if skipped.ok() != Some(length) {
                    return Err(cut_off());
                }
                continue;
            }
            if length > MAX_RECORD {
                return Err(KIND.too_large(format!(
                    "a record has {length} bytes, {MAX_RECORD} are the most"
                )));
            }
            self.content.clear();
            // Memory grows with the bytes that are there.
            let read = content.read_to_end(&mut self.content);
            if read.ok() != Some(length as usize) {
                return Err(cut_off());
            }
            return Ok(Record::of(code, &self.content));
        }
    }
}

/// Splits the next record of a kind that is read off the records of a chunk. None at their end.
///
/// # Errors
/// `Malformed` if a record is longer than what is left.
pub(super) fn split<'a>(records: &mut &'a [u8]) -> Result<Option<Record<'a>>, FormatError> {
    while !records.is_empty() {
        let (head, rest) = records.split_first_chunk::<HEAD>().ok_or_else(cut_off)?;
        let (code, length) = parse(head);
        let length = usize::try_from(length).map_err(|_| cut_off())?;
        let (content, rest) = rest.split_at_checked(length).ok_or_else(cut_off)?;
        *records = rest;
        if let Some(record) = Record::of(code, content) {
            return Ok(Some(record));
        }
    }
    Ok(None)
}

fn parse(head: &[u8; HEAD]) -> (u8, u64) {
    let [code, length @ ..] = *head;
    (code, u64::from_le_bytes(length))
}

fn cut_off() -> FormatError {
    KIND.malformed("it ends in the middle of a record")
}
