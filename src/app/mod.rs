//! The server process: assembles the components, starts them in order, and stops them in order.

mod backup;
mod devices;
mod housekeeping;
mod migrate;
mod outbox;
mod process;
mod reload;
mod settings;
mod shared_threads;
mod shutdown;
mod start;
mod stores;
#[cfg(test)]
mod tests;

pub use backup::{Backup, backup, restore};
pub use migrate::migrate;
pub use start::App;
