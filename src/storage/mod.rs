//! Storage of payloads, snapshots, motion fields and results.

mod blob;
mod blobs;
mod bucket;
mod copy;
mod folder;
mod objects;

pub use blob::{Blob, BlobError, FreeSpace, Fsync};
pub use blobs::Blobs;
pub use bucket::BucketError;
pub use copy::{Copied, copy_store, keep_only};
pub use objects::Objects;
