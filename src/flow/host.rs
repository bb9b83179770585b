//! The host's threads, and what is done on them whatever the device: alignment, and the search for
//! movers. It must not know what a device is.

use std::sync::Arc;

use super::backend::BackendError;
use super::ego;
use super::label::{self, Clouds, Labelled};
use super::options::LabelOptions;
use super::points::{Point, RigidTransform};
use super::watch::Watch;

/// A set of the host's threads.
#[derive(Clone, Debug)]
pub struct Host {
    name: String,
    threads: Arc<rayon::ThreadPool>,
}

impl Host {
    /// So many threads, or as many as there are cores; `known` for the instruction set of what
    /// computes on them besides, where there is one.
    ///
    /// # Errors
    /// [`BackendError::Threads`] where the operating system gives none.
    pub(crate) fn new(threads: Option<usize>, known: Option<&str>) -> Result<Self, BackendError> {
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(threads.unwrap_or(0))
            .thread_name(|i| format!("fnsf-cpu-{i}"))
            .build()
            .map_err(|error| BackendError::Threads(error.to_string()))?;
        let count = threads.current_num_threads();
        Ok(Self {
            name: match known {
                Some(isa) => format!("cpu ({isa}, {count} threads)"),
                None => format!("cpu ({count} threads)"),
            },
            threads: Arc::new(threads),
        })
    }

    /// What it is, as reports show it.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The threads themselves.
    pub(crate) fn threads(&self) -> &Arc<rayon::ThreadPool> {
        &self.threads
    }

    /// The rigid motion target_from_source, near `prior`, that aligns `source` with `target`; the
    /// motion so far where `watch` interrupts.
    pub fn align(
        &self,
        source: &[Point],
        target: &[Point],
        prior: &RigidTransform,
        watch: &dyn Watch,
    ) -> RigidTransform {
        let align = || ego::align(source, target, prior, watch);
        self.threads.install(align)
    }

    /// What moves in `clouds`; what has been found so far where `watch` interrupts.
    pub fn movers(
        &self,
        clouds: &Clouds<'_>,
        options: &LabelOptions,
        watch: &dyn Watch,
    ) -> Labelled {
        let find = || label::label(clouds, options, watch);
        self.threads.install(find)
    }
}
