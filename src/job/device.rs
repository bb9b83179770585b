//! Where work may be done: what a request may ask for, and the kinds of device that there are.

use std::str::FromStr;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::options::InvalidOptions;

/// Where the work is done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeviceChoice {
    /// The fastest that is there: a GPU, or the CPU where there is none.
    #[default]
    Auto,
    /// The CPU's vector units.
    Cpu,
    /// A GPU, and nothing else.
    Gpu,
}

impl DeviceChoice {
    /// The kind of device that it has to be; none where any will do.
    pub fn kind(self) -> Option<DeviceKind> {
        match self {
            Self::Auto => None,
            Self::Cpu => Some(DeviceKind::Cpu),
            Self::Gpu => Some(DeviceKind::Gpu),
        }
    }
}

impl FromStr for DeviceChoice {
    type Err = InvalidOptions;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu),
            _ => Err(InvalidOptions::Device(text.to_owned())),
        }
    }
}

/// What a device is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum DeviceKind {
    /// The CPU's vector units.
    Cpu,
    /// A GPU.
    Gpu,
}

impl DeviceKind {
    /// All kinds.
    pub const ALL: [Self; 2] = [Self::Cpu, Self::Gpu];

    /// The name that requests and metrics use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Gpu => "gpu",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_is_read_alike_from_json_and_from_a_word() {
        for choice in [DeviceChoice::Auto, DeviceChoice::Cpu, DeviceChoice::Gpu] {
            let json = serde_json::to_string(&choice).expect("JSON");
            assert_eq!(json.trim_matches('"').parse(), Ok(choice));
        }
        let refused = "tpu".parse::<DeviceChoice>().expect_err("a refusal");
        assert!(refused.to_string().contains("device is \"tpu\""));
    }
}
