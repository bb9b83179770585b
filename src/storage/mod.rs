//! Storage of payloads, snapshots, motion fields and results.

mod blobs;

pub use crate::storage::blobs::{Blob, BlobError, Blobs, FreeSpace, Fsync};
