//! Options of an estimate and their defaults.
//!
//! The values of the presets are defined here and nowhere else.

mod field;
mod loss;
mod model;
mod objects;
mod pair;
mod partition;
mod preset;

pub(crate) use field::DeadlineLimits;
pub use field::{
    BatchGrowth, EarlyStopOptions, FieldOptions, LearningRateSchedule, ResultChoice, WarmStart,
};
pub use loss::{ChamferOptions, DistanceLossOptions, LossOptions, NearestSearch, Renewal};
pub use model::{
    InputNormalization, LinearOptions, ModelOptions, NetworkOptions, Precision, Start,
};
pub use objects::ObjectOptions;
pub use pair::{
    CERTAIN_OVERLAP, DEFAULT_DT_S, Ego, Ground, LEAST_OVERLAP, MAX_SPREAD_M, Method, Options,
};
pub use partition::PartitionOptions;
pub use preset::Preset;
