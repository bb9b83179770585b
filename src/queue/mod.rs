//! The durable job queue: jobs are submitted, leased to workers, and finished.
//!
//! Payloads and options are opaque to the queue. It orders the pairs of a sequence. A sequence may
//! have a closing job, which is queued under the sequence's own id when all pairs have succeeded.
//! [`Queue`] is the interface; [`SqliteQueue`] implements it on one machine. Independent of
//! protocols, workers and solvers.

mod backlog;
#[cfg(test)]
mod contract_tests;
mod lease;
mod sqlite;
mod subscriptions;
mod types;

pub use backlog::{Backlog, Load};
pub use lease::{Lease, LeaseHeartbeat, Signal};
pub use sqlite::SqliteQueue;
pub use types::{
    Committed, Event, Filter, Idempotency, Outcome, PairOf, Queue, QueueError, QueueOptions,
    Submission, Submitted,
};
