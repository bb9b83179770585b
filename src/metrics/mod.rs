//! The Prometheus metrics of the server: their names, labels and buckets.
//!
//! Every series exists from the start, so their number is constant. No label holds a job or a
//! tenant. Job ids are exemplars.

mod exposition;
mod labels;
mod process;
mod record;
mod register;
mod series;

pub use labels::{CLASSES, DELIVERY_OUTCOMES, PHASES, PROTOCOLS, REJECTIONS};
pub use record::ConnectionGuard;
pub use series::Metrics;
