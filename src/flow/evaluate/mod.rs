//! How good a flow is: the metrics of the paper and of the field's two public benchmarks.
//!
//! Works on arrays in memory; it must not know where a flow or its truth came from.
//! The paper's metrics are those of its evaluation code; the benchmarks are Argoverse 2's scene
//! flow task (three-way EPE) and its second edition (bucket-normalized EPE).

mod argoverse;
mod buckets;
mod classes;
mod metrics;
mod reliability;
mod three_way;
mod truth;

pub use argoverse::{Argoverse2, Argoverse2Pool, evaluate_argoverse2};
pub use buckets::{Bucket, BucketNormalized, BucketReport, ClassError, UNCLASSIFIED};
pub use classes::{CLASSES, class_of_category, class_of_foreground};
pub use metrics::{Metrics, Pool, evaluate};
pub use reliability::{Calibration, CalibrationBin, Reliability};
pub use three_way::{Part, ThreeWay};
pub use truth::{CLOSE_HALF_WIDTH_M, EvaluateError, Truth};
