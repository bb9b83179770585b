//! An opened GPU with the state that all pairs on it share.

use std::sync::{Arc, Mutex, OnceLock};

use super::adapter::{Adapter, AdapterKind};
use super::batcher::Batch;
use super::cluster_search::ClusterSearches;
use super::context::Context;
use super::half::Units;
use super::memory::GpuOptions;
use super::self_test::{SelfTestError, tested_units};
use crate::flow::data::locked;
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
    /// Whether the GPU finds normals and searches clusters, if it can run the kernels.
    pub(super) searches_clusters: bool,
    pub(super) cluster_searches: Arc<ClusterSearches>,
    units: Arc<Tested<Units>>,
}

/// What passed a self-test, or why it did not.
#[derive(Debug)]
struct Tested<T> {
    known: OnceLock<Result<T, String>>,
    /// Held during the self-test.
    testing: Mutex<()>,
}

impl<T> Default for Tested<T> {
    fn default() -> Self {
        Self {
            known: OnceLock::new(),
            testing: Mutex::default(),
        }
    }
}

impl<T> Tested<T> {
    /// The result of `test`, which runs once, and again if it lacked memory.
    ///
    /// # Errors
    /// [`BackendError::Busy`] or [`BackendError::Memory`] if the test lacked memory now.
    fn get_or_test(
        &self,
        test: impl FnOnce() -> Result<T, SelfTestError>,
    ) -> Result<&Result<T, String>, BackendError> {
        let _one_at_a_time = match self.known.get() {
            Some(known) => return Ok(known),
            None => locked(&self.testing),
        };
        if let Some(known) = self.known.get() {
            return Ok(known);
        }
        let tested = match test() {
            Err(SelfTestError::Backend(error)) if error.is_out_of_memory() => return Err(error),
            tested => tested.map_err(|error| error.to_string()),
        };
        Ok(self.known.get_or_init(|| tested))
    }
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
            searches_clusters: threads
                <= options.cluster_threads(adapter.kind).saturating_mul(lanes),
            context: Arc::new(context),
            batch: Arc::default(),
            host,
            name: format!(
                "{} ({}, {})",
                adapter.name, adapter.interface, adapter.driver
            ),
            kind: adapter.kind,
            cluster_searches: Arc::default(),
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
    /// once, and again if it lacked memory.
    ///
    /// # Errors
    /// [`BackendError::Busy`] or [`BackendError::Memory`] if the GPU has no memory for the self-test
    /// now.
    pub(super) fn tested_units(&self) -> Result<&Result<Units, String>, BackendError> {
        self.units.get_or_test(|| {
            let tile = self.context.tile.clone().map_err(SelfTestError::NoUnits)?;
            tested_units(&self.context, tile, tile.sources())
        })
    }

    /// The kernels for the matrix units.
    ///
    /// # Errors
    /// [`BackendError::Unsupported`] if there are no matrix units, or they failed their self-test.
    /// Also as [`Self::tested_units`].
    pub(super) fn units(&self) -> Result<&Units, BackendError> {
        let text = "half precision needs matrix units that pass their self-test";
        let units = self.tested_units()?.as_ref();
        units.map_err(|_| BackendError::Unsupported(text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_self_test_is_repeated_only_if_it_lacked_memory() {
        let units = Tested::default();
        let short = units.get_or_test(|| Err(SelfTestError::Backend(BackendError::Busy)));
        assert!(matches!(short, Err(BackendError::Busy)));
        let failed = units.get_or_test(|| Err(SelfTestError::NoUnits("none".to_owned())));
        assert_eq!(failed.expect("a result"), &Err("none".to_owned()));
        let again = units.get_or_test(|| Ok(1));
        assert_eq!(again.expect("a result"), &Err("none".to_owned()));
    }
}
