//! The device that a request may choose, and the kinds of device.

use std::str::FromStr;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::error::InvalidOptions;

/// The device that a request asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DeviceChoice {
    /// Any device: in the service the first that is free, on the command line a GPU or, if there is
    /// none, the CPU.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU. The request is refused if there is none.
    Gpu,
}

impl DeviceChoice {
    /// The required kind of device; none if any kind will do.
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

/// The kind of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceKind {
    /// The CPU.
    Cpu,
    /// A GPU.
    Gpu,
}

impl DeviceKind {
    /// All kinds.
    pub const ALL: [Self; 2] = [Self::Cpu, Self::Gpu];

    /// The name in requests and metrics.
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
