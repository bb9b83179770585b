//! Conversion of requests into domain types. Unknown enum values are refused with the name of the field.

use std::time::Duration;

use tonic::metadata::MetadataMap;

use super::proto;
use crate::api::error::ApiError;
use crate::flow::RigidTransform;
use crate::formats::{ego_motion, rigid_motion};
use crate::job::{
    Densify, DeviceChoice, EgoChoice, FieldChoices, GroundChoice, JobOptions, Labels,
    LaterSweepsChoice, PrecisionChoice, PresetChoice, Priority, State,
};

fn unknown(field: &str, number: i32) -> ApiError {
    ApiError::InvalidOptions(format!("options: {field} has no value {number}"))
}

/// Converts and checks the options of a job. A missing message means the defaults.
///
/// # Errors
/// [`ApiError::InvalidOptions`].
pub(super) fn options(message: Option<Box<proto::Options>>) -> Result<JobOptions, ApiError> {
    let Some(message) = message else {
        return Ok(JobOptions::default());
    };
    let preset = match proto::Preset::try_from(message.preset) {
        Ok(proto::Preset::Unspecified | proto::Preset::Default) => PresetChoice::Default,
        Ok(proto::Preset::Label) => PresetChoice::Label,
        Ok(proto::Preset::Neural) => PresetChoice::Neural,
        Ok(proto::Preset::Paper) => PresetChoice::Paper,
        Ok(proto::Preset::NsfpBaseline) => PresetChoice::NsfpBaseline,
        Ok(proto::Preset::Nsfp) => PresetChoice::Nsfp,
        Ok(proto::Preset::NsfpPlusPlus) => PresetChoice::NsfpPlusPlus,
        Ok(proto::Preset::NsfpPlusPlusDt) => PresetChoice::NsfpPlusPlusDt,
        Ok(proto::Preset::NsfpKdtree) => PresetChoice::NsfpKdtree,
        Ok(proto::Preset::FnsfLinear) => PresetChoice::FnsfLinear,
        Ok(proto::Preset::NsfpLinear) => PresetChoice::NsfpLinear,
        Ok(proto::Preset::NsfpKdtreeLinear) => PresetChoice::NsfpKdtreeLinear,
        Err(_) => return Err(unknown("preset", message.preset)),
    };
    let ground = match proto::Ground::try_from(message.ground) {
        Ok(proto::Ground::Unspecified) => None,
        Ok(proto::Ground::Keep) => Some(GroundChoice::Keep),
        Ok(proto::Ground::Mask) => Some(GroundChoice::Mask),
        Ok(proto::Ground::Auto) => Some(GroundChoice::Auto),
        Err(_) => return Err(unknown("ground", message.ground)),
    };
    let priority = match proto::Priority::try_from(message.priority) {
        Ok(proto::Priority::Unspecified | proto::Priority::Normal) => Priority::Normal,
        Ok(proto::Priority::Low) => Priority::Low,
        Ok(proto::Priority::High) => Priority::High,
        Err(_) => return Err(unknown("priority", message.priority)),
    };
    let device = match proto::Device::try_from(message.device) {
        Ok(proto::Device::Unspecified | proto::Device::Auto) => DeviceChoice::Auto,
        Ok(proto::Device::Cpu) => DeviceChoice::Cpu,
        Ok(proto::Device::Gpu) => DeviceChoice::Gpu,
        Err(_) => return Err(unknown("device", message.device)),
    };
    let precision = match proto::Precision::try_from(message.precision) {
        Ok(proto::Precision::Unspecified | proto::Precision::F32) => PrecisionChoice::F32,
        Ok(proto::Precision::F16) => PrecisionChoice::F16,
        Err(_) => return Err(unknown("precision", message.precision)),
    };
    let options = JobOptions {
        preset,
        seed: message.seed,
        max_points: message.max_points,
        crop_m: message.crop_m,
        min_range_m: message.min_range_m,
        force: message.force,
        dt_s: message.dt_s,
        ground,
        ego: ego(message.ego, &message.ego_motion)?,
        device,
        precision,
        field: message
            .field
            .map(|message| field(*message))
            .unwrap_or_default(),
        deadline_ms: message.deadline_ms,
        priority,
        labels: Labels(message.labels.into_iter().collect()),
        webhook: Some(message.webhook).filter(|url| !url.is_empty()),
        result_uri: Some(message.result_uri).filter(|uri| !uri.is_empty()),
        densify: message.densify.map(densify).transpose()?,
    };
    options.check()?;
    Ok(options)
}

fn field(message: proto::FieldOptions) -> FieldChoices {
    FieldChoices {
        cell_m: message.cell_m,
        truncation_m: message.truncation_m,
        voxel_m: message.voxel_m,
        sigma_m: message.sigma_m,
        variation_weight: message.variation_weight,
        first_points: message.first_points,
        double_every: message.double_every,
        double_at_fall: message.double_at_fall,
        renew_every: message.renew_every,
        max_iterations: message.max_iterations,
        learning_rate: message.learning_rate,
        patience: message.patience,
        min_delta: message.min_delta,
        bev: message.bev,
    }
}

fn densify(message: proto::Densify) -> Result<Densify, ApiError> {
    let later_sweeps = match proto::LaterSweeps::try_from(message.later_sweeps) {
        Ok(proto::LaterSweeps::Unspecified | proto::LaterSweeps::Reverse) => {
            LaterSweepsChoice::Reverse
        }
        Ok(proto::LaterSweeps::Inverse) => LaterSweepsChoice::Inverse,
        Err(_) => return Err(unknown("densify.later_sweeps", message.later_sweeps)),
    };
    Ok(Densify {
        reference_time: message.reference_time,
        substeps: message.substeps.unwrap_or(1),
        later_sweeps,
    })
}

fn ego(named: i32, motion: &[f64]) -> Result<Option<EgoChoice>, ApiError> {
    let invalid = |text: &str| ApiError::InvalidOptions(format!("options: {text}"));
    let named = proto::Ego::try_from(named).map_err(|_| unknown("ego", named))?;
    match (named, motion.len()) {
        (proto::Ego::Unspecified, 0) => Ok(None),
        (proto::Ego::Off, 0) => Ok(Some(EgoChoice::Off)),
        (proto::Ego::Auto, 0) => Ok(Some(EgoChoice::Auto)),
        (proto::Ego::Unspecified, 16) => {
            let motion =
                ego_motion(&matrix(motion)).map_err(|error| invalid(&error.to_string()))?;
            Ok(Some(EgoChoice::Given(motion)))
        }
        (proto::Ego::Unspecified, _) => Err(invalid("ego_motion has 16 numbers, row by row")),
        _ => Err(invalid("ego and ego_motion exclude each other")),
    }
}

/// A 4 x 4 matrix from its 16 numbers, row by row.
fn matrix(numbers: &[f64]) -> [[f64; 4]; 4] {
    core::array::from_fn(|row| core::array::from_fn(|column| numbers[4 * row + column]))
}

/// The pose of a sweep: none, or 16 numbers. `sweep` is its name for errors, which may be empty.
pub(super) fn pose(sweep: &str, numbers: &[f64]) -> Result<Option<RigidTransform>, ApiError> {
    let sweep = if sweep.is_empty() { "a sweep" } else { sweep };
    let refused = |text: String| ApiError::BadInput(format!("the pose of {sweep}: {text}"));
    match numbers.len() {
        0 => Ok(None),
        16 => match rigid_motion(&matrix(numbers)) {
            Ok(pose) => Ok(Some(pose)),
            Err(error) => Err(refused(error.to_string())),
        },
        count => Err(refused(format!("{count} numbers where 16 are needed"))),
    }
}

/// The state that a list request filters by. `None` for all states.
pub(super) fn wanted_state(number: i32) -> Result<Option<State>, ApiError> {
    let found = match proto::State::try_from(number) {
        Ok(proto::State::Unspecified) => None,
        Ok(proto::State::Queued) => Some(State::Queued),
        Ok(proto::State::Running) => Some(State::Running),
        Ok(proto::State::Succeeded) => Some(State::Succeeded),
        Ok(proto::State::Failed) => Some(State::Failed),
        Ok(proto::State::Cancelled) => Some(State::Cancelled),
        Ok(proto::State::Expired) => Some(State::Expired),
        Err(_) => return Err(ApiError::BadRequest(format!("there is no state {number}"))),
    };
    Ok(found)
}

/// The deadline of the call as a duration, from `grpc-timeout`: at most eight digits and a unit.
/// `None` if it is missing or malformed.
pub(super) fn time_left(metadata: &MetadataMap) -> Option<Duration> {
    let text = metadata.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > 8 {
        return None;
    }
    let count: u64 = digits.parse().ok()?;
    Some(match unit {
        "H" => Duration::from_secs(count * 3600),
        "M" => Duration::from_secs(count * 60),
        "S" => Duration::from_secs(count),
        "m" => Duration::from_millis(count),
        "u" => Duration::from_micros(count),
        "n" => Duration::from_nanos(count),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_numbers_and_contradictions_are_refused_by_name() {
        let refused = |change: fn(&mut proto::Options)| {
            let mut message = proto::Options::default();
            change(&mut message);
            options(Some(Box::new(message)))
                .expect_err("a refusal")
                .to_string()
        };
        assert!(refused(|o| o.preset = 99).contains("preset has no value 99"));
        assert!(refused(|o| o.priority = -1).contains("priority has no value -1"));
        assert!(refused(|o| o.device = 9).contains("device has no value 9"));
        assert!(refused(|o| o.precision = 8).contains("precision has no value 8"));
        assert!(refused(|o| o.ego_motion = vec![1.0; 3]).contains("16 numbers"));
        let nowhere = |o: &mut proto::Options| {
            o.densify = Some(proto::Densify {
                reference_time: f64::NAN,
                ..proto::Densify::default()
            });
        };
        assert!(refused(nowhere).contains("densify.reference_time is NaN"));
        assert!(refused(|o| o.crop_m = Some(f32::NAN)).contains("crop_m"));
        assert!(refused(|o| o.min_range_m = Some(f32::NAN)).contains("min_range_m"));
        assert!(refused(|o| o.max_points = Some(1)).contains("max_points is 1"));
        assert_eq!(options(Some(Box::default())), Ok(JobOptions::default()));
        assert_eq!(options(None), Ok(JobOptions::default()));
    }

    #[test]
    fn every_preset_has_a_value_with_its_name() {
        for preset in crate::flow::Preset::ALL {
            let name = preset.name().replace('-', "_").replace('+', "_plus");
            let name = name.to_uppercase();
            let value = proto::Preset::from_str_name(&format!("PRESET_{name}"));
            let message = proto::Options {
                preset: value.expect("the protocol has the preset").into(),
                ..proto::Options::default()
            };
            let read = options(Some(Box::new(message))).expect("good options");
            assert_eq!(read.preset.preset(), preset);
        }
    }

    #[test]
    fn deadlines_of_calls_are_read_in_every_unit() {
        let read = |text: &'static str| {
            let mut metadata = MetadataMap::new();
            metadata.insert("grpc-timeout", text.parse().expect("plain text"));
            time_left(&metadata)
        };
        assert_eq!(read("300m"), Some(Duration::from_millis(300)));
        assert_eq!(read("2S"), Some(Duration::from_secs(2)));
        assert_eq!(read("1H"), Some(Duration::from_secs(3600)));
        for nonsense in ["", "S", "123456789S", "-1S", "5x"] {
            assert_eq!(read(nonsense), None, "{nonsense}");
        }
    }
}
