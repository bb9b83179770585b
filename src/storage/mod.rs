//! Where payloads, snapshots and results lie.

mod blobs;

pub use blobs::{Blob, BlobError, Blobs, FreeSpace, Sync};
