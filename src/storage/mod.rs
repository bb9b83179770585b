//! Storage of payloads, snapshots and results.

mod blobs;

pub use crate::storage::blobs::{Blob, BlobError, Blobs, FreeSpace, Fsync};
