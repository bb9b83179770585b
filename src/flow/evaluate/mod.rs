//! Evaluation metrics of scene flow: those of the paper and of two public benchmarks.
//!
//! Works on arrays in memory. The paper's metrics follow its evaluation code. The benchmarks are
//! the Argoverse 2 scene flow task (three-way EPE) and its second edition (bucket-normalized EPE).
//! The calibration of the confidence and the tracks of a sequence are measured as well.

mod argoverse;
mod assignment;
mod buckets;
mod classes;
mod metrics;
mod reliability;
mod three_way;
mod tracking;
mod truth;

pub use argoverse::{Argoverse2, Argoverse2Pool, evaluate_argoverse2};
pub use buckets::{Bucket, BucketNormalized, BucketReport, ClassError, UNCLASSIFIED};
pub use classes::{CLASSES, class_of_category, class_of_foreground};
pub use metrics::{Metrics, Pool, evaluate};
pub use reliability::{Calibration, CalibrationBin, Reliability};
pub use three_way::{Part, ThreeWay};
pub use tracking::{
    MATCHED_WITHIN_M, TRACKED_FROM_MPS, TRACKED_FROM_POINTS, TrackedObject, TrackedSweep,
    TrackingMetrics, TrackingPool, tracked_sweeps,
};
pub use truth::{CLOSE_HALF_WIDTH_M, EvaluateError, Truth};
