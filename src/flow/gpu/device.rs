//! An opened GPU with the state that all pairs on it share.

use std::sync::OnceLock;

use super::adapter::{Adapter, AdapterKind};
use super::batcher::Batch;
use super::context::Context;
use super::half::Units;
use super::memory::GpuOptions;
use super::self_test::tested_units;
use crate::flow::field::BackendError;
use crate::flow::host::Host;

/// An opened GPU, shared by all fits on it.
pub(super) struct Device {
    pub(super) context: Context,
    pub(super) batch: Batch,
    pub(super) host: Host,
    pub(super) name: String,
    pub(super) kind: AdapterKind,
    /// The kernel of the object search.
    pub(super) clusters: OnceLock<wgpu::ComputePipeline>,
    units: OnceLock<Result<Units, String>>,
}

impl Device {
    /// Opens a GPU, allocates its memory and builds its kernels.
    ///
    /// # Errors
    /// [`BackendError`] if the driver refuses, or the GPU has too little memory.
    pub(super) fn open(adapter: &Adapter, options: &GpuOptions) -> Result<Self, BackendError> {
        Ok(Self {
            context: Context::open(adapter, options)?,
            batch: Batch::default(),
            host: Host::new(options.host_threads, None)?,
            name: format!(
                "{} ({}, {})",
                adapter.name, adapter.interface, adapter.driver
            ),
            kind: adapter.kind,
            clusters: OnceLock::new(),
            units: OnceLock::new(),
        })
    }

    /// The kernels for the matrix units, or the reason why they cannot be used. The self-test runs
    /// once.
    pub(super) fn tested_units(&self) -> &Result<Units, String> {
        self.units.get_or_init(|| {
            let tile = self.context.tile.clone()?;
            tested_units(&self.context, tile, tile.sources())
        })
    }

    /// The kernels for the matrix units.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] if there are no matrix units, or they failed their self-test.
    pub(super) fn units(&self) -> Result<&Units, BackendError> {
        let text = "half precision needs matrix units that pass their self-test";
        let units = self.tested_units().as_ref();
        units.map_err(|_| BackendError::Unsupported(text))
    }
}
