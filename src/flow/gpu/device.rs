//! An opened GPU with the state that all pairs on it share.

use std::sync::{Arc, OnceLock};

use super::adapter::{Adapter, AdapterKind};
use super::batcher::Batch;
use super::context::Context;
use super::half::Units;
use super::memory::GpuOptions;
use super::self_test::tested_units;
use crate::flow::field::BackendError;
use crate::flow::host::Host;

/// An opened GPU with threads of the host. Clones share all of it.
#[derive(Clone)]
pub(super) struct Device {
    pub(super) context: Arc<Context>,
    pub(super) batch: Arc<Batch>,
    pub(super) host: Host,
    pub(super) name: String,
    pub(super) kind: AdapterKind,
    /// Whether the GPU searches clusters, if it can run their kernel.
    pub(super) searches_clusters: bool,
    /// The kernel of the object search.
    pub(super) clusters: Arc<OnceLock<wgpu::ComputePipeline>>,
    units: Arc<OnceLock<Result<Units, String>>>,
}

impl Device {
    /// Opens a GPU, allocates its memory and builds its kernels.
    ///
    /// # Errors
    /// [`BackendError`] if the driver refuses, or the GPU has too little memory.
    pub(super) fn open(adapter: &Adapter, options: &GpuOptions) -> Result<Self, BackendError> {
        let context = Context::open(adapter, options)?;
        let host = Host::new(options.host_threads, None)?;
        let threads = host.threads().current_num_threads();
        let lanes = context.budget.lanes as usize;
        Ok(Self {
            searches_clusters: adapter.kind != AdapterKind::Software
                && threads <= options.cluster_threads.saturating_mul(lanes),
            context: Arc::new(context),
            batch: Arc::default(),
            host,
            name: format!(
                "{} ({}, {})",
                adapter.name, adapter.interface, adapter.driver
            ),
            kind: adapter.kind,
            clusters: Arc::default(),
            units: Arc::default(),
        })
    }

    /// The same GPU, with `threads` threads of the host of its own.
    ///
    /// # Errors
    /// [`BackendError::Threads`] if the operating system cannot start the threads.
    pub(super) fn beside(&self, threads: usize) -> Result<Self, BackendError> {
        Ok(Self {
            host: self.host.beside(threads, None)?,
            ..self.clone()
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
