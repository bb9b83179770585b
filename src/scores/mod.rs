//! Scores of flows against their truth: every metric of [`crate::flow::evaluate`] together, as one
//! JSON object.

mod accumulate;
mod buckets;
mod report;

pub use accumulate::{Scores, truth_of};
pub use buckets::{BucketNormalizedReport, ClassReport, SPEEDS_M, SpeedReport};
pub use report::{Argoverse2Report, ConfidenceReport, MovingReport, Report, ThreeWayReport};
