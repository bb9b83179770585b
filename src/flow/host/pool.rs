//! The host's threads, and what is done on them whatever the device: ground, alignment, and the
//! search for movers. What is found of a sweep by itself is found once, as long as it is remembered.
//! It must not know what a device is.

use std::sync::Arc;

use rayon::prelude::*;

use super::sweep_cache::SweepCache;
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::field::BackendError;
use crate::flow::objects::{ObjectSearch, SearchClouds};
use crate::flow::options::ObjectOptions;
use crate::flow::{ground, objects, registration};

/// A set of the host's threads.
#[derive(Clone)]
pub struct Host {
    name: String,
    threads: Arc<rayon::ThreadPool>,
    sweep_cache: Arc<SweepCache>,
}

impl core::fmt::Debug for Host {
    fn fmt(&self, formatter: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        formatter.write_str(&self.name)
    }
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
            sweep_cache: Arc::default(),
        })
    }

    /// What it is, as reports show it.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Forgets what it has found of sweeps, as a measurement wants it that does the same twice.
    pub fn forget(&self) {
        self.sweep_cache.forget();
    }

    /// The threads themselves.
    pub(crate) fn threads(&self) -> &Arc<rayon::ThreadPool> {
        &self.threads
    }

    /// The rigid motion target_from_source, near `prior`, that aligns `source` with `target`; the
    /// motion so far where `control` interrupts.
    pub fn align(
        &self,
        source: &[Point],
        target: &[Point],
        prior: &RigidTransform,
        control: &dyn Control,
    ) -> RigidTransform {
        let known = [source, target].map(|points| self.sweep_cache.of(points));
        self.threads.install(|| {
            let (source, target) = rayon::join(|| known[0].surface(), || known[1].surface());
            registration::align(source, target, prior, control)
        })
    }

    /// Which points of each sweep are ground; all of them are finite and in range.
    pub(crate) fn ground(&self, sweeps: &[&[Point]]) -> Vec<Vec<bool>> {
        let known: Vec<_> = sweeps
            .iter()
            .map(|points| self.sweep_cache.of(points))
            .collect();
        let found = known
            .par_iter()
            .map(|known| known.ground(ground::mask).clone());
        self.threads.install(|| found.collect())
    }

    /// What moves in `clouds`; what has been found so far where `control` interrupts.
    pub fn find_objects(
        &self,
        clouds: &SearchClouds<'_>,
        options: &ObjectOptions,
        control: &dyn Control,
    ) -> ObjectSearch {
        let find = || objects::find_objects(clouds, options, control);
        self.threads.install(find)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Uncontrolled;
    use crate::flow::simulate::{Street, StreetOptions};

    #[test]
    fn what_is_remembered_of_sweeps_does_not_change_a_bit() {
        let options = StreetOptions {
            frames: 3,
            azimuth_steps: 500,
            ..StreetOptions::default()
        };
        let street = Street::new(&options).expect("a street");
        let sweeps = [0, 1, 2].map(|k| street.frame(k).expect("a sweep").points);
        let prior = RigidTransform::identity();
        let aligned = |host: &Host, source: usize, target: usize| {
            host.align(&sweeps[source], &sweeps[target], &prior, &Uncontrolled)
        };
        let host = Host::new(Some(2), None).expect("threads");
        for (source, target) in [(0, 1), (1, 2), (2, 0), (1, 0), (0, 1)] {
            let fresh = Host::new(Some(1), None).expect("threads");
            assert_eq!(
                aligned(&host, source, target),
                aligned(&fresh, source, target)
            );
            let sweeps = [sweeps[source].as_slice(), &sweeps[target]];
            assert_eq!(host.ground(&sweeps), fresh.ground(&sweeps));
        }
    }
}
