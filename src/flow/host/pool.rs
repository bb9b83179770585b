//! The host's thread pool, and the stages that run on it with every backend: ground segmentation,
//! registration and the object search.
//!
//! Results that depend on a single sweep are cached.

use core::convert::Infallible;
use std::sync::Arc;

use rayon::prelude::*;

use super::sweep_cache::{self, CachedSweep, SweepCache};
use crate::flow::data::{Control, Point, RigidTransform};
use crate::flow::objects::{ClusterDevice, ObjectSearch, SearchClouds};
use crate::flow::options::ObjectOptions;
use crate::flow::registration::Registration;
use crate::flow::{ground, objects, registration};

/// A pool of CPU threads with a cache of the ground masks and the surfels of the latest sweeps.
/// Clones share both.
#[derive(Clone)]
pub struct Host {
    name: String,
    threads: Arc<rayon::ThreadPool>,
    sweep_cache: Arc<SweepCache>,
}

/// The operating system could not start the threads.
#[derive(Debug, thiserror::Error)]
#[error("cannot start worker threads: {0}")]
pub struct HostError(String);

impl core::fmt::Debug for Host {
    fn fmt(&self, formatter: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        formatter.write_str(&self.name)
    }
}

impl Host {
    /// Starts `threads` threads, or one for each core. `isa` is the instruction set of the CPU
    /// backend that shares the threads, if there is one; it appears in the name.
    ///
    /// # Errors
    /// [`HostError`] where the operating system cannot start the threads.
    pub(crate) fn new(threads: Option<usize>, isa: Option<&str>) -> Result<Self, HostError> {
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(threads.unwrap_or(0))
            .thread_name(|i| format!("fnsf-cpu-{i}"))
            .build()
            .map_err(|error| HostError(error.to_string()))?;
        let count = match threads.current_num_threads() {
            1 => "1 thread".to_owned(),
            count => format!("{count} threads"),
        };
        Ok(Self {
            name: match isa {
                Some(isa) => format!("cpu ({isa}, {count})"),
                None => format!("cpu ({count})"),
            },
            threads: Arc::new(threads),
            sweep_cache: Arc::default(),
        })
    }

    /// Threads of its own that share the cache of this pool, as in [`Self::new`].
    ///
    /// # Errors
    /// [`HostError`] where the operating system cannot start the threads.
    pub(crate) fn beside(&self, threads: usize, isa: Option<&str>) -> Result<Self, HostError> {
        Ok(Self {
            sweep_cache: Arc::clone(&self.sweep_cache),
            ..Self::new(Some(threads), isa)?
        })
    }

    /// Name for reports: the instruction set of the CPU backend, if given, and the number of
    /// threads.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Clears the cache of ground masks and surfels, so that a measurement that repeats the same
    /// work computes them again.
    pub fn clear_cache(&self) {
        self.sweep_cache.clear();
    }

    /// Does `work` on these threads: for functions that take no backend and compute in parallel, such
    /// as those of [`crate::flow::ground`] and [`crate::flow::simulate`]. Elsewhere they use rayon's
    /// global threads.
    pub fn install<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        self.threads.install(work)
    }

    /// The thread pool.
    pub(crate) fn threads(&self) -> &Arc<rayon::ThreadPool> {
        &self.threads
    }

    /// Registers `source` (N x 3) to `target` (M x 3), metres, each in its own frame, and returns
    /// the rigid motion `target_from_source` with its covariance. The method is generalized ICP (Segal et al. 2009),
    /// started from a coarse search around `prior`.
    ///
    /// In directions that the clouds do not determine, the motion stays as in `prior`. It equals
    /// `prior` if a cloud is empty or the clouds have nothing in common. Points that are not finite
    /// are ignored. If `control` interrupts, the result is the motion so far. The result is
    /// bit-identical for any number of threads.
    pub fn align(
        &self,
        source: &[Point],
        target: &[Point],
        prior: &RigidTransform,
        control: &dyn Control,
    ) -> Registration {
        let known = [source, target].map(|points| self.sweep_cache.of(points));
        self.threads.install(|| {
            let (source, target) = rayon::join(|| known[0].surface(), || known[1].surface());
            registration::align(source, target, prior, control)
        })
    }

    /// Ground masks of the sweeps, one flag a point. All points must be finite and in range.
    pub(crate) fn ground(&self, sweeps: &[&[Point]]) -> Vec<Vec<bool>> {
        self.of_each(sweeps, |known| known.ground(ground::mask).clone())
    }

    /// [`Self::ground`], and beside it the downsampled clouds and the indices of the sweeps, which their
    /// registration needs next.
    pub(crate) fn ground_and_surfels(&self, sweeps: &[&[Point]]) -> Vec<Vec<bool>> {
        let points: usize = sweeps.iter().map(|points| points.len()).sum();
        if points > sweep_cache::POINTS {
            // They would not be kept until the registration.
            return self.ground(sweeps);
        }
        self.of_each(sweeps, |known| {
            let ground = || known.ground(ground::mask).clone();
            rayon::join(ground, || _ = known.surface()).0
        })
    }

    /// `compute` of each sweep, in parallel.
    fn of_each<T: Send>(
        &self,
        sweeps: &[&[Point]],
        compute: impl Fn(&CachedSweep) -> T + Sync,
    ) -> Vec<T> {
        let known: Vec<_> = sweeps
            .iter()
            .map(|points| self.sweep_cache.of(points))
            .collect();
        self.threads
            .install(|| known.par_iter().map(|known| compute(known)).collect())
    }

    /// Searches `clouds` for moving objects, large clusters first. If `control` interrupts or too
    /// little time is left, the other clusters are not searched, and [`ObjectSearch::interrupted`]
    /// is the reason. A cluster that was not searched is static, unless it lies beside a larger
    /// moving object whose motion fits it. An interrupt before the first cluster can leave the
    /// lists of the result empty.
    pub fn find_objects(
        &self,
        clouds: &SearchClouds<'_>,
        options: &ObjectOptions,
        control: &dyn Control,
    ) -> ObjectSearch {
        let on_host: Result<_, Infallible> = self.find_objects_with(clouds, options, None, control);
        on_host.unwrap_or_else(|never| match never {})
    }

    /// [`Self::find_objects`] with the clusters searched by `device`, if there is one.
    ///
    /// # Errors
    /// That of the device.
    pub(crate) fn find_objects_with<E: Send>(
        &self,
        clouds: &SearchClouds<'_>,
        options: &ObjectOptions,
        device: Option<&ClusterDevice<'_, E>>,
        control: &dyn Control,
    ) -> Result<ObjectSearch, E> {
        let find = || objects::find_objects(clouds, options, device, control);
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
            sweeps: 3,
            azimuth_steps: 500,
            ..StreetOptions::default()
        };
        let street = Street::new(&options).expect("a street");
        let sweeps = [0, 1, 2].map(|k| street.sweep(k).expect("a sweep").points);
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
