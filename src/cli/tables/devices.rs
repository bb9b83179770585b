//! The devices of the table: the CPU, and a GPU for the methods that have kernels for it.

use anyhow::anyhow;

use crate::cli::device;
use crate::cli::device::DeviceArgument;
use crate::cli::failure::Failure;
use crate::flow::field::Backend;
use crate::flow::{FieldOptions, Options};
use crate::job::DeviceChoice;

/// The open devices.
pub(super) struct Devices {
    cpu: Box<dyn Backend>,
    /// The device asked for; none for the CPU.
    other: Option<Box<dyn Backend>>,
}

impl Devices {
    /// Opens the CPU with `threads` threads, and the device asked for.
    pub(super) fn open(asked: &DeviceArgument, threads: Option<usize>) -> Result<Self, Failure> {
        let other = match asked.choice {
            DeviceChoice::Cpu => None,
            DeviceChoice::Gpu => Some(device::open(asked, threads)?),
            DeviceChoice::Auto => {
                let text = "--device auto: name cpu or gpu, so that it is known what is measured";
                return Err(Failure::usage(anyhow!(text)));
            }
        };
        let cpu = device::cpu(threads).map_err(Failure::internal)?;
        Ok(Self { cpu, other })
    }

    /// The device for a method with `options`.
    pub(super) fn of(&self, options: &Options) -> &dyn Backend {
        let has_kernels = options.field().is_some_and(FieldOptions::runs_on_gpu);
        let other = self.other.as_deref().filter(|_| has_kernels);
        other.unwrap_or(self.cpu.as_ref())
    }
}
