//! Workers: each leases a job, runs it on its lane, stores the result and finishes the attempt.
//!
//! There is one worker for each lane of a device. The result is stored before the queue records the
//! success, and only the attempt that holds the job counts.

mod commit;
mod control;
mod densify;
mod isolation;
mod load;
mod probe;
mod run;
#[cfg(test)]
mod tests;

pub use isolation::IsolationLock;
pub use probe::StoreProbe;
pub use run::{Drain, Worker, WorkerOptions};
