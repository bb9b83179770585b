//! The values of options that have names: presets, ground, ego motion, precision and priority.

use std::str::FromStr;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use utoipa::ToSchema;

use super::error::InvalidOptions;
use crate::flow::{Preset, RigidTransform};
use crate::formats::{ego_motion, matrix_rows};

/// A named set of solver options.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum,
)]
#[serde(rename_all = "kebab-case")]
pub enum PresetChoice {
    /// Rigid motion of each object; the remaining points move with the ego motion.
    #[default]
    Default,
    /// As default, and a pair of a sequence also uses its neighbor sweeps.
    Label,
    /// A short, robust fit of a neural field.
    Neural,
    /// FNSF as published.
    Paper,
    /// The baseline of FNSF's comparison: a network fitted to the truncated Chamfer distance.
    NsfpBaseline,
    /// NSFP: as nsfp-baseline, with a second network for the backward flow.
    Nsfp,
    /// NSFP++: ego motion, then a fit as nsfp for each cluster of points.
    #[serde(rename = "nsfp++")]
    #[value(name = "nsfp++")]
    NsfpPlusPlus,
    /// As nsfp++, fitted to distance transforms.
    #[serde(rename = "nsfp++-dt")]
    #[value(name = "nsfp++-dt")]
    NsfpPlusPlusDt,
    /// As nsfp-baseline, with k-d trees for the nearest neighbors.
    NsfpKdtree,
    /// The linear model of FNSF's comparison, fitted to the distance transform.
    FnsfLinear,
    /// The linear model, fitted to the truncated Chamfer distance.
    NsfpLinear,
    /// As nsfp-linear, with k-d trees for the nearest neighbors.
    NsfpKdtreeLinear,
}

impl PresetChoice {
    /// The solver's preset.
    pub fn preset(self) -> Preset {
        match self {
            Self::Default => Preset::Default,
            Self::Label => Preset::Label,
            Self::Neural => Preset::Neural,
            Self::Paper => Preset::Paper,
            Self::NsfpBaseline => Preset::NsfpBaseline,
            Self::Nsfp => Preset::Nsfp,
            Self::NsfpPlusPlus => Preset::NsfpPlusPlus,
            Self::NsfpPlusPlusDt => Preset::NsfpPlusPlusDt,
            Self::NsfpKdtree => Preset::NsfpKdtree,
            Self::FnsfLinear => Preset::FnsfLinear,
            Self::NsfpLinear => Preset::NsfpLinear,
            Self::NsfpKdtreeLinear => Preset::NsfpKdtreeLinear,
        }
    }
}

/// Treatment of ground points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum GroundChoice {
    /// As any other point.
    Keep,
    /// Points marked in the masks ground1 and ground2 of the pair are left out.
    Mask,
    /// Ground points move with the ego motion. They are taken from the masks, or segmented if there
    /// are no masks.
    Auto,
}

/// Precision of the network's matrix products during the fit of a field, see
/// [`crate::flow::Precision`].
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema, clap::ValueEnum,
)]
#[serde(rename_all = "snake_case")]
pub enum PrecisionChoice {
    /// Single precision.
    #[default]
    F32,
    /// Half-precision factors in the layers from 128 to 128 features, on the matrix units of a GPU.
    /// Refused for the device `cpu` and for presets that fit no field.
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

/// Priority of a job. Jobs of a higher priority always start first. Within one priority, tenants
/// share fairly.
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
    /// Batch work.
    Low,
    /// The default.
    #[default]
    Normal,
    /// Interactive work.
    High,
}

impl Priority {
    /// All priorities, lowest first.
    pub const ALL: [Self; 3] = [Self::Low, Self::Normal, Self::High];

    /// The name in requests and metrics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Low => "low",
            Self::Normal => "normal",
            Self::High => "high",
        }
    }
}

/// The ego motion of a pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EgoChoice {
    /// Not removed: it is part of the flow that the method estimates.
    Off,
    /// Estimated first.
    Auto,
    /// Given as target_from_source, translation in metres.
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
