//! The host's thread pool and its cache of per-sweep results.

mod pool;
mod sweep_cache;

pub use pool::{Host, HostError};
