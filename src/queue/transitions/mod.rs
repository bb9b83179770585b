//! The state transitions of jobs, the same for every engine.
//!
//! Each is a few statements inside a transaction ([`Sql`](super::sql::Sql)). Notifications, counts
//! and wake-ups are collected in [`Effects`](super::effects::Effects) and applied only after the commit.
//!
//! On PostgreSQL several transactions run at once. The first statement of a transition locks the
//! row of the job's sequence, or of the job itself ([`rows::lock`]): no other transition of the
//! same sequence runs until the commit. A claim is the exception, and locks only the row that it
//! takes.

pub(super) mod clock;
pub(super) mod expiry;
pub(super) mod fair_queue;
mod finish;
pub(super) mod leases;
pub(super) mod lists;
pub(super) mod outbox;
mod rows;
pub(super) mod standing;
mod submit;

pub(super) use finish::{abandon, cancel, make_durable, requeue};
pub(super) use rows::{get, pairs};
pub(super) use submit::{probe, submit};
