//! Deterministic simulation of the queue: clients, workers, clocks, disk and crashes on one thread.
//!
//! ```text
//! bytes -> steps -> calls of the Queue -> turns of the writer -> answers, events, rows
//!                                                                  -> promises
//! ```
//!
//! A schedule is a list of bytes. Each step starts a call, commits what is pending, moves the clocks, or
//! lets something fail. The code under test is the product's own: [`DatabaseQueue`], the state transitions,
//! the writer's transactions and the leases. Only the thread of the writer, the disk and the clocks are
//! simulated. [`run`] checks the promises of the queue at every answer, at every event and in all rows,
//! and panics where one is broken.
//!
//! [`DatabaseQueue`]: crate::queue::database::DatabaseQueue

mod calls;
#[cfg(test)]
mod clock;
mod engine;
mod process;
mod promises;
mod rows;
pub(in crate::queue) mod steps;
#[cfg(test)]
mod tests;
mod world;

/// Runs one schedule to the end of all its jobs. Any bytes are a schedule.
///
/// # Panics
/// If a promise of the queue is broken.
pub fn run(schedule: &[u8]) {
    world::World::run(steps::Bytes::new(schedule));
}
