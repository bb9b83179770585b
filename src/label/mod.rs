//! Bulk labelling: the flows of all pairs of many drives, by any number of processes.
//!
//! ```text
//! manifest, folder or data set - Plan - Shard - read ahead - estimate - write ahead - labels
//! ```
//!
//! The processes share nothing but the output. The name of a pair's output is a function of the pair,
//! and an output is written only where there is none, or where it lacks a sweep that can be read now. So
//! a process that dies loses the pair that it computed, and two that do the same pair leave one output.

mod datasets;
mod error;
mod estimates;
mod finalize;
mod io;
mod layout;
mod manifest;
mod pipeline;
mod places;
mod plan;
mod report;
mod run;
mod settings;
mod shard;
mod tally;
mod types;

pub use datasets::{Dataset, DatasetError};
pub use error::{LabelError, OtherRun};
pub use finalize::{Finalized, finalize};
pub use layout::Layout;
pub use manifest::{ManifestError, read_manifest};
pub use places::{Place, PlaceError};
pub use plan::{Drive, DriveSweep, Plan, PlanError};
pub use report::{Outcome, RowReport};
pub use run::{open_plan, run};
pub use settings::Settings;
pub use shard::{Shard, ShardError};
pub use types::{Done, Inputs, Solver, Told};
