//! The embedded queue: one SQLite file in WAL mode, one writer thread, and concurrent readers.
//!
//! Durable changes are on disk before they are acknowledged (`synchronous = FULL`). A lock file
//! admits one process at a time, so jobs that were running when the last process ended can be
//! requeued at once.

mod effects;
mod expiry;
mod fair_queue;
mod files;
mod finish;
mod heartbeat;
mod leases;
mod rows;
mod schema;
mod shared;
mod store;
mod submit;
#[cfg(test)]
mod tests;
mod writer;

pub use store::SqliteQueue;
