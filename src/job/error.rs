//! Errors of job options.

use std::time::Duration;

use crate::flow::MIN_POINTS;
use crate::flow::densify::PlanError;
use crate::formats::INTERVAL_S;

/// The longest allowed deadline.
pub(super) const MAX_DEADLINE: Duration = Duration::from_secs(24 * 60 * 60);

/// Why options are refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidOptions {
    /// The text is not one JSON object, has an unknown key, or has a value that cannot be read;
    /// with the reason.
    #[error("options: {0}")]
    Json(String),
    /// `max_points` is less than [`MIN_POINTS`], which every method needs.
    #[error("options: max_points is {0}, at least {MIN_POINTS} are needed")]
    MaxPoints(u32),
    /// The name of the device is unknown.
    #[error("options: device is {0:?}, \"auto\", \"cpu\" and \"gpu\" are known")]
    Device(String),
    /// The name of the precision is unknown.
    #[error("options: precision is {0:?}, \"f32\" and \"f16\" are known")]
    Precision(String),
    /// Half precision (`f16`) with device `cpu`, which computes in single precision only.
    #[error("options: precision is \"f16\", which the CPU does not compute in")]
    HalfOnCpu,
    /// Device `gpu` with a field that has no kernels for a GPU; with the name of the preset.
    #[error(
        "options: device is \"gpu\", but {0} with these options is computed on the CPU alone: leave device out"
    )]
    NoGpuKernels(&'static str),
    /// Half precision with a preset that has no kernels for it; with the name of the preset.
    #[error("options: precision is \"f16\", which {0} does not compute in: take preset neural")]
    HalfWithoutKernels(&'static str),
    /// An option of `field` that the preset has no use for.
    #[error("options: field.{option} has no effect with preset {preset}: leave it out")]
    NoUse {
        /// The name of the option.
        option: &'static str,
        /// The name of the preset.
        preset: &'static str,
    },
    /// A value of `field` that is out of range, or a combination that is not possible; with the
    /// reason.
    #[error("options: {0}")]
    FieldRange(&'static str),
    /// A value of `field` that the fit refuses; with the reason.
    #[error("options: field: {0}")]
    Field(String),
    /// The crop is not a positive, finite number of metres.
    #[error("options: crop_m is {0}, a positive number of metres is needed")]
    Crop(f32),
    /// The least range is not a positive, finite number of metres.
    #[error("options: min_range_m is {0}, a positive number of metres is needed")]
    MinRange(f32),
    /// The time between two sweeps, seconds, is not within [`INTERVAL_S`].
    #[error(
        "options: dt_s is {0}, {least} to {most} seconds are possible",
        least = INTERVAL_S[0],
        most = INTERVAL_S[1]
    )]
    Dt(f32),
    /// There are more labels than possible; with their number.
    #[error("options: {0} labels are too many, 16 are possible")]
    Labels(usize),
    /// A label whose name or value is refused; with its name.
    #[error(
        "options: label {0:?}: a name has 1 to 63 letters, digits, '-', '_', '.' or '/', a value at most \
         255 bytes without control characters"
    )]
    Label(String),
    /// The deadline, milliseconds, is zero or longer than a day.
    #[error("options: deadline_ms is {0}, 1 to {max} are possible", max = MAX_DEADLINE.as_millis())]
    Deadline(u64),
    /// The reference time of the dense cloud, in sweeps, is negative or not finite.
    #[error("options: densify.reference_time is {0}, a time in sweeps from 0 is needed")]
    ReferenceTime(f64),
    /// A dense cloud is impossible: the substeps are not 1 to 64, the reference time lies after the
    /// last sweep, or there are fewer than two sweeps.
    #[error("options: densify: {0}")]
    Densify(PlanError),
    /// The ego motion is a given matrix, and the sequence has more than one pair.
    #[error(
        "options: a given ego is the motion of one pair, not of a sequence's: leave it out, or send the \
         poses of the sweeps"
    )]
    OneMotion,
    /// The sweeps have poses, and the ego motion is off or a given matrix.
    #[error("options: the poses of the sweeps give the ego motion: leave ego out")]
    PosesAndEgo,
    /// `densify` is given for a single pair or for a streamed sequence.
    #[error("options: densify is for sequences that are submitted as jobs")]
    NoSequence,
}
