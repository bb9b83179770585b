//! TODO doc

mod pool;
mod sweep_cache;

pub use pool::Host;
