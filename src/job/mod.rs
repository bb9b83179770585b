//! What a job is: its name, its options, its states, and what is known about it.
//!
//! The vocabulary that the doors, the queue and the workers share; it must not know any of them.

mod device;
mod id;
mod options;
mod record;
mod report;
mod sequence;

pub use device::{DeviceChoice, DeviceKind};
pub use id::{InvalidId, JobId, Tenant};
pub use options::{
    EgoChoice, GroundChoice, InvalidOptions, JobOptions, PrecisionChoice, PresetChoice, Priority,
};
pub use record::{Job, JobError, JobProgress, Kind, State};
pub use report::{DenseReport, PhaseSeconds, Report};
pub use sequence::{Densify, LaterChoice};
