//! The kinds of files, and the errors of reading and writing them.
//!
//! Every error names the kind of file and the cause. Independent of paths, callers and status
//! codes.

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
    /// Arrow IPC file, the format of Argoverse 2's sweeps.
    Feather,
    /// JSON: a flow, or the similarity transform of a ground raster.
    Json,
    /// LAS, or LAZ, its compressed form, which is written only.
    Las,
    /// A recording of a robot, with the clouds of many sweeps.
    Mcap,
    /// HDF5: a scene of OpenSceneFlow, with many sweeps.
    Hdf5,
    /// PNG: a depth image, 16-bit gray.
    Png,
    /// A camera: this project's JSON, or KITTI's calibration text.
    Camera,
    /// Poses of a sequence: KITTI's text, or JSON. Argoverse 2's are a [`FileKind::Feather`].
    Poses,
    /// KITTI: rows of four little-endian float32 (x, y, z in metres, intensity).
    KittiBin,
    /// nuScenes: rows of five little-endian float32 (x, y, z in metres, intensity, ring).
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
            Self::Mcap => "mcap",
            Self::Hdf5 => "hdf5",
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
    /// The content is of no kind that the function reads; with the reason.
    #[error(
        "unrecognized file: {0}; known are npy, npz, ply, pcd, feather, las, laz, kitti bin and nuscenes bin, and json for a flow"
    )]
    Unrecognized(String),
    /// The content can be read in several ways, and neither the content nor the name decides
    /// between them; with the reason.
    #[error("ambiguous file: {0}")]
    Ambiguous(String),
    /// The file violates its own format, is truncated, or has a value outside of the range of its
    /// column, such as a confidence above 1.
    #[error("malformed {kind} file: {detail}")]
    Malformed {
        /// The kind of file.
        kind: FileKind,
        /// The violation.
        detail: String,
    },
    /// The file is valid, but uses a feature that is refused or not supported.
    #[error("unsupported {kind} file: {detail}")]
    Unsupported {
        /// The kind of file.
        kind: FileKind,
        /// The feature.
        detail: String,
    },
    /// A required array, column or property is missing.
    #[error("{kind} file lacks {what}; it has {present}")]
    Missing {
        /// The kind of file.
        kind: FileKind,
        /// The required item.
        what: String,
        /// The items that the file has.
        present: String,
    },
    /// A camera with invalid parameters.
    #[error(transparent)]
    Camera(#[from] crate::flow::depth::CameraError),
    /// A matrix, text or quaternion is not a rigid motion, or its translation is too long; with the
    /// reason.
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
    /// A coordinate, displacement or other number is larger in magnitude than
    /// [`MAX_COORDINATE_M`](super::MAX_COORDINATE_M).
    #[error("{kind} file, row {row}, column {column}: {value} m is out of range (limit {limit} m)")]
    OutOfRange {
        /// The kind of file.
        kind: FileKind,
        /// Row, counted from 0.
        row: usize,
        /// Column, by name.
        column: String,
        /// The value found: metres for a coordinate or displacement, otherwise the unit of its
        /// column.
        value: f64,
        /// The largest magnitude accepted, in the unit of the value.
        limit: f64,
    },
    /// The file has or declares more data than is accepted.
    #[error("{kind} file is too large: {detail}")]
    TooLarge {
        /// The kind of file.
        kind: FileKind,
        /// The declared size, and the limit.
        detail: String,
    },
    /// An array or column does not have one row per point or pixel, or a file of poses does not
    /// have one pose per sweep.
    #[error("{what} has {found} rows where {expected} are needed")]
    RowCount {
        /// Name of the array, column or file.
        what: String,
        /// Its number of rows.
        found: usize,
        /// The number of rows required.
        expected: usize,
    },
    /// An output file name or ending is that of no known format.
    #[error("cannot tell the format of {name:?}: end it in one of {known}")]
    UnknownExtension {
        /// The name or ending given.
        name: String,
        /// The known endings.
        known: &'static str,
    },
    /// Writing to the output failed.
    #[error("failed to write")]
    Write(#[from] std::io::Error),
    /// A library that encodes the file failed, or could not write to the output.
    #[error("failed to encode a {kind} file: {detail}")]
    Encode {
        /// The kind of file.
        kind: FileKind,
        /// The library's message.
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

/// Names for a message: the first 16, shortened, so that a hostile file cannot fill a log.
fn list(names: &[String]) -> String {
    const SHOWN: usize = 16;
    let mut shown: Vec<String> = names.iter().take(SHOWN).map(|name| shorten(name)).collect();
    if names.len() > SHOWN {
        shown.push(format!("{} more", names.len() - SHOWN));
    }
    shown.join(", ")
}

/// Text from a file, for a message: at most 48 characters, control characters escaped.
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
