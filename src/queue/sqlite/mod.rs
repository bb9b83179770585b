//! The embedded engine: one SQLite file in WAL mode, one writer thread, and concurrent readers.
//!
//! Durable changes are on disk before they are acknowledged (`synchronous = FULL`). A lock file
//! admits one process at a time, so jobs that were running when the last process ended can be
//! requeued at once.

mod backup;
mod engine;
mod files;
mod heartbeat;
mod schema;
#[cfg(any(test, feature = "fuzzing"))]
pub mod simulation;
mod statements;
#[cfg(test)]
mod tests;
mod writer;

pub use backup::{CopiedQueue, copy_sqlite, read_copy};
pub use engine::{migrate_sqlite, open_sqlite};
