//! Why a file was refused, and the names of the kinds of files.
//!
//! Every error names the kind of file and what in it is wrong; it must not know paths, callers or
//! status codes.

use std::fmt;

/// A kind of file that this module reads or writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum FileKind {
    /// One numpy array.
    Npy,
    /// Named numpy arrays in a zip archive.
    Npz,
    /// Stanford polygon file.
    Ply,
    /// Point Cloud Library file.
    Pcd,
    /// Arrow IPC file, as Argoverse 2 ships its sweeps.
    Feather,
    /// JSON flow.
    Json,
    /// LAS, or LAZ, its compressed form. Written only.
    Las,
    /// A picture; depth is read from those of 16 bits of gray.
    Png,
    /// A camera: our JSON, or KITTI's calibration text.
    Camera,
    /// Poses of a sequence: KITTI's text, or our JSON.
    Poses,
    /// KITTI: rows of four little-endian float32 (x, y, z, intensity).
    KittiBin,
    /// nuScenes: rows of five little-endian float32 (x, y, z, intensity, ring).
    NuscenesBin,
}

impl fmt::Display for FileKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Npy => "npy",
            Self::Npz => "npz",
            Self::Ply => "ply",
            Self::Pcd => "pcd",
            Self::Feather => "feather",
            Self::Json => "json",
            Self::Las => "las",
            Self::Png => "png",
            Self::Camera => "camera",
            Self::Poses => "poses",
            Self::KittiBin => "kitti bin",
            Self::NuscenesBin => "nuscenes bin",
        })
    }
}

/// Why a file was refused or could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// The content is of no known kind.
    #[error(
        "unrecognized file: {0}; known are npy, npz, ply, pcd, feather, json, kitti bin and nuscenes bin"
    )]
    Unrecognized(String),
    /// The content fits more than one reading, and nothing says which.
    #[error("ambiguous file: {0}")]
    Ambiguous(String),
    /// The file breaks its own format, or ends too early.
    #[error("malformed {kind} file: {detail}")]
    Malformed {
        /// The kind of file.
        kind: FileKind,
        /// What is wrong with it.
        detail: String,
    },
    /// The file is sound, but uses something that is refused or not read.
    #[error("unsupported {kind} file: {detail}")]
    Unsupported {
        /// The kind of file.
        kind: FileKind,
        /// What it uses.
        detail: String,
    },
    /// An array, column or property that is needed is not there.
    #[error("{kind} file lacks {what}; it has {present}")]
    Missing {
        /// The kind of file.
        kind: FileKind,
        /// What was looked for.
        what: String,
        /// What the file has instead.
        present: String,
    },
    /// A camera that cannot be.
    #[error(transparent)]
    Camera(#[from] crate::flow::depth::CameraError),
    /// A matrix is no rigid motion.
    #[error("{0}")]
    Motion(&'static str),
    /// A value is NaN or infinite.
    #[error("{kind} file, row {row}, column {column}: {value} is not a finite number")]
    NotFinite {
        /// The kind of file.
        kind: FileKind,
        /// Row, counted from 0.
        row: usize,
        /// Column, by name.
        column: String,
        /// The value found.
        value: f64,
    },
    /// A coordinate lies further out than any lidar sees.
    #[error("{kind} file, row {row}, column {column}: {value} m is out of range (limit {limit} m)")]
    OutOfRange {
        /// The kind of file.
        kind: FileKind,
        /// Row, counted from 0.
        row: usize,
        /// Column, by name.
        column: String,
        /// The value found, metres.
        value: f64,
        /// The largest magnitude taken, metres.
        limit: f64,
    },
    /// The file declares more than is read.
    #[error("{kind} file is too large: {detail}")]
    TooLarge {
        /// The kind of file.
        kind: FileKind,
        /// What is declared, and the limit.
        detail: String,
    },
    /// Two arrays of one file, or of one table to be written, do not belong together.
    #[error("{what} has {found} rows where {expected} are needed")]
    RowCount {
        /// The array.
        what: String,
        /// Its rows.
        found: usize,
        /// The rows it should have.
        expected: usize,
    },
    /// An output name whose ending names no format.
    #[error("cannot tell the format of {name:?}: end it in one of {known}")]
    UnknownExtension {
        /// The name or ending given.
        name: String,
        /// The endings that are known.
        known: &'static str,
    },
    /// Writing failed.
    #[error("failed to write")]
    Write(#[from] std::io::Error),
    /// A library that encodes the file failed.
    #[error("failed to encode a {kind} file: {detail}")]
    Encode {
        /// The kind of file.
        kind: FileKind,
        /// What the library said.
        detail: String,
    },
}

impl FileKind {
    pub(super) fn malformed(self, detail: impl Into<String>) -> FormatError {
        FormatError::Malformed {
            kind: self,
            detail: detail.into(),
        }
    }

    pub(super) fn unsupported(self, detail: impl Into<String>) -> FormatError {
        FormatError::Unsupported {
            kind: self,
            detail: detail.into(),
        }
    }

    pub(super) fn missing(self, what: impl Into<String>, present: &[String]) -> FormatError {
        let present = if present.is_empty() {
            "nothing".to_owned()
        } else {
            list(present)
        };
        FormatError::Missing {
            kind: self,
            what: what.into(),
            present,
        }
    }

    pub(super) fn too_large(self, detail: impl Into<String>) -> FormatError {
        FormatError::TooLarge {
            kind: self,
            detail: detail.into(),
        }
    }

    pub(super) fn encode(self, error: impl fmt::Display) -> FormatError {
        FormatError::Encode {
            kind: self,
            detail: error.to_string(),
        }
    }
}

/// Names for a message; a hostile file with a thousand of them does not get to fill a log.
fn list(names: &[String]) -> String {
    const SHOWN: usize = 16;
    let mut shown: Vec<String> = names.iter().take(SHOWN).map(|name| shorten(name)).collect();
    if names.len() > SHOWN {
        shown.push(format!("{} more", names.len() - SHOWN));
    }
    shown.join(", ")
}

/// Text taken from a file, cut to a length that a message can carry, control characters escaped.
pub(super) fn shorten(text: &str) -> String {
    const SHOWN: usize = 48;
    let mut short: String = text
        .chars()
        .take(SHOWN)
        .flat_map(char::escape_debug)
        .collect();
    if text.chars().nth(SHOWN).is_some() {
        short.push_str("...");
    }
    short
}
