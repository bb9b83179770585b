//! The durable job queue: jobs are submitted, leased to workers, and finished.
//!
//! Payloads and options are opaque to the queue. It orders the pairs of a sequence. A sequence may
//! have a closing job, which is queued under the sequence's own id when all pairs have succeeded.
//! [`Queue`] is the interface. The state transitions are written once, as statements of SQL, and run
//! on one of two engines: [`open_sqlite`] for one process, [`open_postgres`] for many nodes.
//! Independent of protocols, workers and solvers.

mod backlog;
#[cfg(test)]
mod contract_tests;
mod database;
mod effects;
mod interface;
mod lease;
mod local;
mod migration;
mod node;
mod outgoing;
mod postgres;
mod sql;
mod sqlite;
mod standing;
mod subscriptions;
mod time;
mod transitions;
mod types;

pub use backlog::{Backlog, Load};
pub use interface::Queue;
pub use lease::{Lease, LeaseHeartbeat, Signal};
pub use migration::Migration;
pub use node::{Capacities, Capacity, Node};
pub use outgoing::{Action, MAX_OUTGOING_DELAY, Outgoing, Settled};
pub use postgres::{PostgresOptions, migrate_postgres, open_postgres};
#[cfg(any(test, feature = "fuzzing"))]
pub use sqlite::simulation;
pub use sqlite::{CopiedQueue, copy_sqlite, migrate_sqlite, open_sqlite, read_copy};
pub use standing::Standing;
pub use types::{
    Committed, Event, Filter, Idempotency, Outcome, PairOf, QueueError, QueueOptions, Submission,
    Submitted,
};
