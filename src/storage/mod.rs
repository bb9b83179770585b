//! Storage of payloads, snapshots, motion fields and results.

mod blob;
mod blobs;
mod bucket;
mod folder;

pub use blob::{Blob, BlobError, FreeSpace, Fsync};
pub use blobs::Blobs;
pub use bucket::BucketError;
