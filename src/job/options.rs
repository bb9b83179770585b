//! What a request may ask for: one set of names for the command line, HTTP and gRPC.
//!
//! Every field has a default and unknown keys are refused. What the names mean to the solver is
//! said here and nowhere else; the presets' values stay in `flow/options.rs`.

use std::str::FromStr;
use std::time::Duration;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use utoipa::ToSchema;

use super::device::{DeviceChoice, DeviceKind};
use super::sequence::Densify;
use crate::flow::densify::PlanError;
use crate::flow::{self, Ego, Ground, MIN_POINTS, Precision, Preset, RigidTransform};
use crate::formats::{ego_motion, matrix_rows};

/// The longest deadline that may be asked for.
const MAX_DEADLINE: Duration = Duration::from_secs(24 * 60 * 60);

/// How a pair's, or a sequence's, flow is found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct JobOptions {
    /// `default`: movers found object by object, everything else still; `label`: `default`, and a pair of
    /// a sequence is found from up to five sweeps; `neural`: a neural field, robust and fast to fit;
    /// `paper`: FNSF as published.
    pub preset: PresetChoice,
    /// The same seed gives the same bits.
    pub seed: u64,
    /// Draw this many points and give the others no flow. `neural` and `paper` draw from each cloud and
    /// leave out the rest; `default` and `label` look at all points all the same.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_points: Option<u32>,
    /// Leave out points with |x| or |y| beyond this, metres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range_m: Option<f32>,
    /// `keep` ground points, leave out those that the clouds' own masks name (`mask`), or let them
    /// move with the vehicle's own motion (`auto`): those of the masks or, without masks, those that
    /// are found; by default what the preset does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ground: Option<GroundChoice>,
    /// The vehicle's own motion: `off`, `auto` (estimate it first) or a 4 x 4 matrix
    /// target_from_source; by default what the preset does.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Object>)]
    pub ego: Option<EgoChoice>,
    /// Where the work is done. A GPU is for `neural` and `paper`; `default` and `label` compute on the
    /// host's processor whatever the device.
    pub device: DeviceChoice,
    /// `f32`: single precision; `f16`: half, for `neural` and `paper` on a GPU whose matrix units pass
    /// their self-test.
    pub precision: PrecisionChoice,
    /// Milliseconds from the request's arrival after which the best flow so far is wanted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline_ms: Option<u64>,
    /// Jobs of a higher priority are started first.
    pub priority: Priority,
    /// One dense cloud of a sequence besides its flows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub densify: Option<Densify>,
}

/// A named set of solver options.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum PresetChoice {
    /// Ours: movers found object by object, everything else still.
    #[default]
    Default,
    /// As default, and a pair of a sequence sees the sweeps around it.
    Label,
    /// Ours with a neural field: robust and fast to fit.
    Neural,
    /// FNSF as published.
    Paper,
}

impl PresetChoice {
    /// The solver's preset.
    pub fn preset(self) -> Preset {
        match self {
            Self::Default => Preset::Default,
            Self::Label => Preset::Label,
            Self::Neural => Preset::Neural,
            Self::Paper => Preset::Paper,
        }
    }
}

/// What becomes of ground points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum GroundChoice {
    /// They are points like any other.
    Keep,
    /// Those that the pair's ground1 and ground2 name are left out.
    Mask,
    /// Those of the masks, or without masks those that are found, move with the vehicle.
    Auto,
}

/// What the factors of the network's products are rounded to.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum PrecisionChoice {
    /// Single precision.
    #[default]
    F32,
    /// Half precision, on the matrix units of a GPU.
    F16,
}

impl FromStr for PrecisionChoice {
    type Err = InvalidOptions;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "f32" => Ok(Self::F32),
            "f16" => Ok(Self::F16),
            _ => Err(InvalidOptions::Precision(text.to_owned())),
        }
    }
}

/// How urgent a job is. Higher ones always go first; within one, tenants share fairly.
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Priority {
    /// Bulk work.
    Low,
    /// Everything else.
    #[default]
    Normal,
    /// Somebody waits.
    High,
}

impl Priority {
    /// All priorities, lowest first.
    pub const ALL: [Self; 3] = [Self::Low, Self::Normal, Self::High];

    /// The name that requests and metrics use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Low => "low",
            Self::Normal => "normal",
            Self::High => "high",
        }
    }
}

/// The vehicle's own motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EgoChoice {
    /// Part of what the field has to explain.
    Off,
    /// Estimated first.
    Auto,
    /// Known, as target_from_source.
    Given(RigidTransform),
}

impl Serialize for EgoChoice {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Off => serializer.serialize_str("off"),
            Self::Auto => serializer.serialize_str("auto"),
            Self::Given(motion) => matrix_rows(motion).serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for EgoChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let wanted = "ego is \"off\", \"auto\" or a 4 x 4 rigid matrix target_from_source";
        match serde_json::Value::deserialize(deserializer)? {
            serde_json::Value::String(name) if name == "off" => Ok(Self::Off),
            serde_json::Value::String(name) if name == "auto" => Ok(Self::Auto),
            rows @ serde_json::Value::Array(_) => {
                let rows: [[f64; 4]; 4] =
                    serde_json::from_value(rows).map_err(|_| D::Error::custom(wanted))?;
                ego_motion(&rows).map(Self::Given).map_err(D::Error::custom)
            }
            _ => Err(D::Error::custom(wanted)),
        }
    }
}

/// Options that make no sense.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidOptions {
    /// Not the JSON object that is wanted.
    #[error("options: {0}")]
    Json(String),
    /// Too few points to fit anything to.
    #[error("options: max_points is {0}, at least {MIN_POINTS} are needed")]
    MaxPoints(u32),
    /// No kind of device.
    #[error("options: device is {0:?}, \"auto\", \"cpu\" and \"gpu\" are known")]
    Device(String),
    /// No precision.
    #[error("options: precision is {0:?}, \"f32\" and \"f16\" are known")]
    Precision(String),
    /// Half precision of a device that has none.
    #[error("options: precision is \"f16\", which the CPU does not compute in")]
    HalfOnCpu,
    /// Half precision of what fits no field.
    #[error("options: precision is \"f16\", which {0} does not compute in: take preset neural")]
    HalfWithoutField(&'static str),
    /// Not a positive number of metres.
    #[error("options: range_m is {0}, a positive number of metres is needed")]
    Range(f32),
    /// No time at all, or more than a day.
    #[error("options: deadline_ms is {0}, 1 to {max} are possible", max = MAX_DEADLINE.as_millis())]
    Deadline(u64),
    /// No frame of any sequence.
    #[error("options: densify.into is {0}, a frame counted from 0 is needed")]
    Into(f64),
    /// The sequence cannot be carried into that frame.
    #[error("options: densify: {0}")]
    Densify(PlanError),
    /// One ego motion for all pairs of a sequence.
    #[error("options: a given ego is the motion of one pair, not of a sequence's: leave it out")]
    OneMotion,
    /// Not a sequence that is submitted whole.
    #[error("options: densify is for sequences that are submitted as jobs")]
    NoSequence,
}

impl JobOptions {
    /// Reads and checks one JSON object.
    ///
    /// # Errors
    /// [`InvalidOptions`], which names the key and what it may be.
    pub fn from_json(text: &[u8]) -> Result<Self, InvalidOptions> {
        // An array would be read as the values of an object without its keys.
        if !text.trim_ascii_start().starts_with(b"{") {
            return Err(InvalidOptions::Json("they are one JSON object".to_owned()));
        }
        let options: Self = serde_json::from_slice(text)
            .map_err(|error| InvalidOptions::Json(error.to_string()))?;
        options.check()?;
        Ok(options)
    }

    /// One JSON object that [`JobOptions::from_json`] reads back.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("every option has a JSON form")
    }

    /// Refuses values that make no sense.
    ///
    /// # Errors
    /// [`InvalidOptions`], which names the key and what it may be.
    pub fn check(&self) -> Result<(), InvalidOptions> {
        if let Some(points) = self.max_points
            && (points as usize) < MIN_POINTS
        {
            return Err(InvalidOptions::MaxPoints(points));
        }
        if let Some(range) = self.range_m
            && !(range.is_finite() && range > 0.0)
        {
            return Err(InvalidOptions::Range(range));
        }
        if let Some(millis) = self.deadline_ms
            && (millis == 0 || u128::from(millis) > MAX_DEADLINE.as_millis())
        {
            return Err(InvalidOptions::Deadline(millis));
        }
        if self.precision == PrecisionChoice::F16 && self.device == DeviceChoice::Cpu {
            return Err(InvalidOptions::HalfOnCpu);
        }
        let preset = self.preset.preset();
        if self.precision == PrecisionChoice::F16 && !Preset::FITTED.contains(&preset) {
            return Err(InvalidOptions::HalfWithoutField(preset.name()));
        }
        self.densify.as_ref().map_or(Ok(()), Densify::check)
    }

    /// The kind of device that it has to be; none where any will do.
    pub fn device_kind(&self) -> Option<DeviceKind> {
        match self.precision {
            PrecisionChoice::F32 => self.device.kind(),
            PrecisionChoice::F16 => Some(DeviceKind::Gpu),
        }
    }

    /// The solver's options for clouds of which the larger has `points` points.
    pub fn solver_options(&self, points: usize) -> flow::Options {
        let drawn = self.max_points.map(|points| points as usize);
        let mut options = self
            .preset
            .preset()
            .options(drawn.filter(|&drawn| drawn < points));
        options.seed = self.seed;
        options.range_m = self.range_m;
        match self.ground {
            None => {}
            Some(GroundChoice::Keep) => options.ground = Ground::Keep,
            Some(GroundChoice::Mask) => options.ground = Ground::Mask,
            Some(GroundChoice::Auto) => options.ground = Ground::Auto,
        }
        match self.ego {
            None => {}
            Some(EgoChoice::Off) => options.ego = Ego::Off,
            Some(EgoChoice::Auto) => options.ego = Ego::Auto,
            Some(EgoChoice::Given(motion)) => options.ego = Ego::Given(motion),
        }
        options.precision = match self.precision {
            PrecisionChoice::F32 => Precision::F32,
            PrecisionChoice::F16 => Precision::F16,
        };
        options
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_object_is_the_default_and_every_option_comes_back() {
        assert_eq!(JobOptions::from_json(b"{}"), Ok(JobOptions::default()));
        let text = br#"{"preset":"paper","seed":7,"max_points":8192,"range_m":51.2,"ground":"mask",
            "ego":[[1,0,0,2],[0,1,0,0],[0,0,1,0],[0,0,0,1]],"device":"cpu","deadline_ms":300,"priority":"high","densify":{"into":1.5}}"#;
        let options = JobOptions::from_json(text).expect("good options");
        assert_eq!(options.preset, PresetChoice::Paper);
        assert_eq!(
            JobOptions::from_json(options.to_json().as_bytes()),
            Ok(options)
        );
    }

    #[test]
    fn half_precision_asks_for_a_gpu() {
        let options = |text: &str| JobOptions::from_json(text.as_bytes());
        let half = options(r#"{"preset":"neural","precision":"f16"}"#).expect("good options");
        assert_eq!(half.device_kind(), Some(DeviceKind::Gpu));
        assert_eq!(half.solver_options(1000).precision, Precision::F16);
        let refused = options(r#"{"precision":"f16","device":"cpu"}"#);
        assert_eq!(refused, Err(InvalidOptions::HalfOnCpu));
        for (preset, fits) in [
            ("default", false),
            ("label", false),
            ("neural", true),
            ("paper", true),
        ] {
            let asked = options(&format!(r#"{{"preset":"{preset}","precision":"f16"}}"#));
            let refused = asked.err();
            assert_eq!(
                refused,
                (!fits).then_some(InvalidOptions::HalfWithoutField(preset))
            );
        }
        let single = options(r#"{"precision":"f32"}"#);
        assert_eq!(single, Ok(JobOptions::default()));
        assert_eq!(JobOptions::default().device_kind(), None);
    }

    #[test]
    fn unknown_keys_and_senseless_values_are_refused_by_name() {
        for (text, said) in [
            (r#"{"sead":1}"#, "unknown field `sead`"),
            (
                r#"{"preset":"best"}"#,
                "unknown variant `best`, expected one of `default`, `label`, `neural`, `paper`",
            ),
            (
                r#"{"device":"gpu:0"}"#,
                "unknown variant `gpu:0`, expected one of `auto`, `cpu`, `gpu`",
            ),
            (r#"{"max_points":2}"#, "max_points is 2"),
            (r#"{"range_m":-1}"#, "range_m is -1"),
            (r#"{"deadline_ms":0}"#, "deadline_ms is 0"),
            (r#"{"ego":"yes"}"#, "ego is \"off\", \"auto\""),
            (
                r#"{"ego":[[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#,
                "not a rigid",
            ),
            (
                r#"{"ego":[[1,0,0,1e300],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#,
                "longer than 1e6 m",
            ),
            (r#"{"densify":{}}"#, "missing field `into`"),
            (
                r#"{"densify":{"into":1,"steps":2}}"#,
                "unknown field `steps`",
            ),
            (r#"{"densify":{"into":-0.5}}"#, "densify.into is -0.5"),
            (
                r#"{"densify":{"into":1,"substeps":65}}"#,
                "densify: 65 substeps: 1 to 64 are possible",
            ),
            (
                r#"{"densify":{"into":1,"later":"never"}}"#,
                "unknown variant `never`",
            ),
            (r#"{"seed":-1}"#, "invalid value"),
            (r#"{"seed":1,"seed":2}"#, "duplicate field"),
            ("[]", "options: "),
            ("", "options: "),
        ] {
            let error = JobOptions::from_json(text.as_bytes())
                .expect_err(text)
                .to_string();
            assert!(error.contains(said), "{text}: {error}");
        }
    }

    #[test]
    fn presets_say_what_becomes_of_ground_where_nothing_else_does() {
        let ground = |text: &str| {
            let options: JobOptions = serde_json::from_str(text).expect("sound options");
            options.solver_options(1000).ground
        };
        assert_eq!(ground(r#"{"preset":"label"}"#), Ground::Auto);
        assert_eq!(
            ground(r#"{"preset":"label","ground":"mask"}"#),
            Ground::Mask
        );
        assert_eq!(ground("{}"), Ground::Auto);
        assert_eq!(ground(r#"{"preset":"paper"}"#), Ground::Keep);
    }
}
