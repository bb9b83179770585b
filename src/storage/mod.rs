//! Where payloads, snapshots and results lie, and whose fault it is when they cannot.

mod blobs;
mod fault;

pub use blobs::{Blob, BlobError, Blobs, FreeSpace, Sync};
pub use fault::Fault;
