//! numpy's `.npz`: named arrays in a zip archive, each read on request.
//!
//! The archive declares the decompressed size of each array, which is checked against the limits
//! before it is decompressed.

use std::cell::Cell;
use std::io::{Cursor, Read, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::error::{FileKind, FormatError, shorten};
use super::limits::{MAX_POINTS, check_flag, check_within, unfold_limit};
use super::npy;
use super::npy::{ArrayPath, Header};
use crate::flow::Point;

const KIND: FileKind = FileKind::Npz;

/// Largest number of members in an archive. Those of datasets have about ten.
const MAX_MEMBERS: usize = 1024;

/// The signature at the start of every entry in a zip's central directory.
const DIRECTORY_ENTRY: &[u8; 4] = b"PK\x01\x02";

/// An open archive.
pub(super) struct Npz<'a> {
    archive: ZipArchive<Cursor<&'a [u8]>>,
    /// Bytes to which the arrays still to be read may decompress.
    budget: Cell<u64>,
    /// Largest number of rows in an array.
    most: usize,
}

impl<'a> Npz<'a> {
    /// Reads the directory. Nothing is decompressed.
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, FormatError> {
        Self::open_within(bytes, MAX_POINTS)
    }

    /// As [`Self::open`], and refuses arrays with more than `most` rows.
    pub(super) fn open_within(bytes: &'a [u8], most: usize) -> Result<Self, FormatError> {
        let entries = bytes
            .windows(4)
            .filter(|window| window == DIRECTORY_ENTRY)
            .count();
        if entries > MAX_MEMBERS {
            return Err(KIND.too_large(format!("{entries} members, {MAX_MEMBERS} are the most")));
        }
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(broken)?;
        Ok(Self {
            archive,
            budget: Cell::new(unfold_limit(bytes.len())),
            most,
        })
    }

    /// Names of the arrays, without `.npy`.
    pub(super) fn names(&self) -> Vec<String> {
        let names = self.archive.file_names().flatten();
        names
            .filter_map(|name| name.strip_suffix(".npy").map(str::to_owned))
            .collect()
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.archive
            .index_for_name(&format!("{name}.npy"))
            .is_some()
    }

    /// Names and shapes, for a message.
    pub(super) fn described(&mut self) -> Vec<String> {
        let names = self.names();
        let describe = |name: &String| match self.header(name) {
            Ok(header) => format!("{} {:?}", shorten(name), header.shape),
            Err(_) => shorten(name),
        };
        names.iter().map(describe).collect()
    }

    /// The header of one array.
    pub(super) fn header(&mut self, name: &str) -> Result<Header, FormatError> {
        self.with(name, |header, _| Ok(header))
    }

    /// Reads N x 3 floats, in metres.
    pub(super) fn points(&mut self, name: &str) -> Result<Vec<Point>, FormatError> {
        let array_path = ArrayPath {
            kind: KIND,
            array: name,
        };
        let most = self.most;
        self.with(name, |header, data| {
            check_within(KIND, header.rows(), most)?;
            npy::read_points(array_path, &header, data)
        })
    }

    /// Reads N booleans: nonzero is true. `None` where there is no such array.
    pub(super) fn mask(&mut self, name: &str) -> Result<Option<Vec<bool>>, FormatError> {
        self.column(name, |row, value| check_flag(KIND, row, name, value))
    }

    /// Reads N numbers. `check` converts each value, given its row. `None` where there is no such
    /// array.
    pub(super) fn column<T>(
        &mut self,
        name: &str,
        check: impl Fn(usize, f64) -> Result<T, FormatError>,
    ) -> Result<Option<Vec<T>>, FormatError> {
        if !self.has(name) {
            return Ok(None);
        }
        let array_path = ArrayPath {
            kind: KIND,
            array: name,
        };
        let most = self.most;
        self.with(name, |header, data| {
            check_within(KIND, header.rows(), most)?;
            npy::read_column(array_path, &header, data, check)
        })
        .map(Some)
    }

    /// Reads a 4 x 4 matrix, row by row. `None` where there is no such array.
    pub(super) fn matrix(&mut self, name: &str) -> Result<Option<[[f64; 4]; 4]>, FormatError> {
        if !self.has(name) {
            return Ok(None);
        }
        let array_path = ArrayPath {
            kind: KIND,
            array: name,
        };
        self.with(name, |header, data| {
            npy::read_matrix(array_path, &header, data)
        })
        .map(Some)
    }

    /// Opens a member, checks the size that its header declares, and passes its data to `read`.
    fn with<T>(
        &mut self,
        name: &str,
        read: impl FnOnce(Header, &mut dyn Read) -> Result<T, FormatError>,
    ) -> Result<T, FormatError> {
        let Some(index) = self.archive.index_for_name(&format!("{name}.npy")) else {
            return Err(KIND.missing(format!("array {name}"), &self.names()));
        };
        let mut member = self.archive.by_index(index).map_err(broken)?;
        let unfolded = member.size();
        let header = Header::read(KIND, &mut member)?;
        let declared = header.data_len(KIND)?;
        if declared.checked_add(header.len as u64) != Some(unfolded) {
            return Err(KIND.malformed(format!(
                "array {} of shape {:?} needs {declared} bytes, the archive declares {unfolded} \
                 with its header",
                shorten(name),
                header.shape
            )));
        }
        let Some(left) = self.budget.get().checked_sub(declared) else {
            return Err(KIND.too_large(format!(
                "array {} unfolds to {declared} bytes, far more than a file of this length holds",
                shorten(name)
            )));
        };
        let mut data = member.take(declared);
        let result = read(header, &mut data)?;
        let untouched = data.limit();
        self.budget.set(left.saturating_add(untouched));
        if untouched == 0 {
            // The checksum is verified only when the member is read to its end.
            match data.into_inner().read(&mut [0]) {
                Ok(0) => {}
                Ok(_) => return Err(KIND.malformed(format!("array {} goes on", shorten(name)))),
                Err(error) => {
                    return Err(KIND.malformed(format!("array {}: {error}", shorten(name))));
                }
            }
        }
        Ok(result)
    }
}

fn broken(error: zip::result::ZipError) -> FormatError {
    match error {
        zip::result::ZipError::UnsupportedArchive(what) => KIND.unsupported(what),
        other => KIND.malformed(other.to_string()),
    }
}

/// Writes arrays one by one into an archive, as `numpy.savez` does. Flags and integers are
/// compressed. Floats are not: compressed, the file of a flow is only 3% smaller.
pub(super) struct NpzWriter {
    archive: ZipWriter<Cursor<Vec<u8>>>,
}

impl NpzWriter {
    /// An empty archive in memory.
    pub(super) fn new() -> Self {
        Self {
            archive: ZipWriter::new(Cursor::new(Vec::new())),
        }
    }

    /// Adds an array, compressed; `write` writes its `.npy` file.
    pub(super) fn array(
        &mut self,
        name: &str,
        write: impl FnOnce(&mut dyn Write) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        self.add(name, CompressionMethod::Deflated, write)
    }

    fn add(
        &mut self,
        name: &str,
        method: CompressionMethod,
        write: impl FnOnce(&mut dyn Write) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        // A fixed time stamp, so that the same flow gives the same bytes.
        let options = SimpleFileOptions::default()
            .compression_method(method)
            // Masks compress equally well at any level.
            .compression_level((method == CompressionMethod::Deflated).then_some(1))
            .last_modified_time(zip::DateTime::default())
            .large_file(true);
        self.archive
            .start_file(format!("{name}.npy"), options)
            .map_err(|error| KIND.encode(error))?;
        write(&mut self.archive)
    }

    pub(super) fn points(&mut self, name: &str, points: &[Point]) -> Result<(), FormatError> {
        self.add(name, CompressionMethod::Stored, |out| {
            npy::write_points(out, points)
        })
    }

    pub(super) fn values(&mut self, name: &str, values: &[f32]) -> Result<(), FormatError> {
        self.add(name, CompressionMethod::Stored, |out| {
            npy::write_values(out, values)
        })
    }

    pub(super) fn mask(&mut self, name: &str, mask: &[bool]) -> Result<(), FormatError> {
        self.array(name, |out| npy::write_mask(out, mask))
    }

    pub(super) fn matrix(&mut self, name: &str, matrix: &[[f64; 4]; 4]) -> Result<(), FormatError> {
        self.array(name, |out| npy::write_matrix(out, matrix))
    }

    /// Ends the archive and returns its bytes.
    pub(super) fn finish(self) -> Result<Vec<u8>, FormatError> {
        let archive = self.archive.finish();
        Ok(archive.map_err(|error| KIND.encode(error))?.into_inner())
    }
}
