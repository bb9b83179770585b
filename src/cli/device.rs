//! The compute device of the command line: the values of `--device`, and opening a device.

use std::fmt;
use std::str::FromStr;

use anyhow::{Context, anyhow};

use super::failure::Failure;
use super::output::complain;
use crate::flow::cpu::CpuBackend;
use crate::flow::field::{Backend, BackendError};
use crate::flow::gpu;
use crate::flow::gpu::{Adapter, Gpu, GpuOptions, Selector};
use crate::job::DeviceChoice;

/// Environment variable for tests. Where it is 1, software drivers, which compute on the CPU, are
/// accepted as GPUs.
const SOFTWARE: &str = "FNSF_ALLOW_SOFTWARE_GPU";

/// The value of `--device`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct DeviceArgument {
    /// The kind of device: auto, cpu or gpu.
    pub(super) choice: DeviceChoice,
    /// The selected GPU, where the kind is gpu.
    adapter: Selector,
}

impl FromStr for DeviceArgument {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = || format!("{text:?} is none of auto, cpu, gpu and gpu:CARD");
        let (kind, adapter) = match text.split_once(':') {
            Some((kind, adapter)) if !adapter.is_empty() => (kind, Some(adapter)),
            Some(_) => return Err(wrong()),
            None => (text, None),
        };
        let choice: DeviceChoice = kind.parse().map_err(|_| wrong())?;
        match adapter {
            Some(_) if choice != DeviceChoice::Gpu => Err(wrong()),
            _ => {
                let Ok(adapter) = Selector::from_str(adapter.unwrap_or_default());
                Ok(Self { choice, adapter })
            }
        }
    }
}

impl fmt::Display for DeviceArgument {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.choice {
            DeviceChoice::Auto => f.write_str("auto"),
            DeviceChoice::Cpu => f.write_str("cpu"),
            DeviceChoice::Gpu => write!(f, "{}", self.adapter),
        }
    }
}

/// Whether software drivers are accepted as GPUs.
pub(super) fn software_is_welcome() -> bool {
    std::env::var_os(SOFTWARE).is_some_and(|value| value == "1")
}

/// The GPU that `auto` selects.
pub(super) fn best_card() -> Result<Adapter, BackendError> {
    gpu::select(&Selector::Any, software_is_welcome())
}

/// Opens a device. `threads` limits the threads of the CPU backend. Prints a warning on stderr
/// where `auto` falls back to the CPU.
pub(super) fn open(
    device: &DeviceArgument,
    threads: Option<usize>,
) -> Result<Box<dyn Backend>, Failure> {
    match device.choice {
        DeviceChoice::Cpu => cpu(threads).map_err(Failure::internal),
        DeviceChoice::Gpu => {
            let opened = gpu::select(&device.adapter, software_is_welcome())
                .and_then(|adapter| open_card(&adapter));
            let opened = opened.with_context(|| format!("--device {device}"));
            opened.map_err(|error| {
                Failure::internal(anyhow!("{error:#}; fnsf doctor says how to mend it"))
            })
        }
        DeviceChoice::Auto => match best_card().and_then(|adapter| open_card(&adapter)) {
            Ok(opened) => Ok(opened),
            Err(error) => {
                stand_in(&error);
                cpu(threads).map_err(Failure::internal)
            }
        },
    }
}

/// The CPU backend, with `threads` threads or one per core.
pub(super) fn cpu(threads: Option<usize>) -> Result<Box<dyn Backend>, BackendError> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let opened = CpuBackend::new(Some(threads.unwrap_or(cores)))?;
    Ok(Box::new(opened))
}

/// Warns on stderr that the CPU is used instead of a GPU.
pub(super) fn stand_in(error: &BackendError) {
    complain(format_args!("warning: the CPU does the work: {error}"));
}

fn open_card(adapter: &Adapter) -> Result<Box<dyn Backend>, BackendError> {
    Ok(Box::new(Gpu::open(adapter, &GpuOptions::default())?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kind_is_named_alone_and_a_card_behind_it() {
        for text in [
            "auto",
            "cpu",
            "gpu",
            "gpu:1",
            "gpu:nvidia",
            "gpu:0000:01:00.0",
        ] {
            let device: DeviceArgument = text.parse().expect(text);
            assert_eq!(device.to_string(), text);
        }
        let by_place: DeviceArgument = "gpu:0000:01:00.0".parse().expect("a device");
        assert_eq!(by_place.adapter, Selector::Named("0000:01:00.0".to_owned()));
        for text in ["", "tpu", "cpu:0", "auto:0", "gpu:", ":0"] {
            assert!(text.parse::<DeviceArgument>().is_err(), "{text}");
        }
    }
}
