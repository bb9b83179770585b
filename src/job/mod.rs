//! The data model of jobs: id, options, states, record and report.
//!
//! Shared by the protocols, the queue and the workers. Independent of them.

mod choices;
mod delivery;
mod densify;
mod device;
mod error;
mod field;
mod id;
mod labels;
mod notice;
mod options;
mod record;
mod report;
mod sequence;

pub use choices::{EgoChoice, GroundChoice, PrecisionChoice, PresetChoice, Priority};
pub use delivery::{Delivery, DeliveryState, PAIR_INDEX, uri_of_pair};
pub use densify::{Densify, LaterSweepsChoice};
pub use device::{DeviceChoice, DeviceKind};
pub use error::InvalidOptions;
pub use field::FieldChoices;
pub use id::{InvalidId, JobId, Tenant};
pub use labels::Labels;
pub use notice::ended_notice;
pub use options::JobOptions;
pub use record::{Job, JobError, JobProgress, Kind, State};
pub use report::{DenseReport, PhaseSeconds, Report, warnings};
