//! Every metric's name, labels and buckets: here and nowhere else.
//!
//! No label holds a job, a tenant or anything else that grows; every series exists from the start.

mod exposition;
mod labels;
mod record;
mod register;
mod series;

pub use labels::{CLASSES, PHASES, PROTOCOLS, REJECTIONS};
pub use record::ConnectionGuard;
pub use series::Metrics;
