//! The engine on PostgreSQL: many nodes, each a process, share one queue.
//!
//! Every change is one transaction on one of a node's connections ([`session`]). Rows are locked
//! as [`transitions`](super::transitions) says, and claims pass over rows that are locked. The time
//! of every transition is the database's, so the clocks of the nodes may differ.
//!
//! Each node holds an advisory lock on one connection of its own for as long as it lives
//! ([`nodes`]). When the lock is free, the other nodes requeue what the node held. On the same
//! connection a node listens to the changes of the others ([`presence`]); [`upkeep`] reads the jobs
//! that this process watches or holds, renews their leases, and handles what is due.

mod backlog;
mod beats;
mod bell;
mod engine;
mod heartbeat;
mod locks;
mod nodes;
mod pool;
mod presence;
mod schema;
mod session;
mod shared;
mod statements;
mod target;
#[cfg(test)]
mod tests;
mod this_node;
mod upkeep;

pub use engine::{migrate_postgres, open_postgres};
pub use target::PostgresOptions;
