//! A device of several lanes, which share the threads of its host.
//!
//! A pair alone gets all threads, and pairs side by side get a share each: the stages of a pair that
//! one thread computes leave the other threads idle, so that more pairs are done with fewer threads
//! each. The flow of a pair does not depend on the number of threads.

use std::sync::{Arc, Mutex, PoisonError};

use crate::engine::Opened;
use crate::flow::cpu::CpuBackend;
use crate::flow::field::{Backend, BackendError};

/// A device that computes some stages on threads of the host.
pub(super) trait Threaded: Backend + Sized + 'static {
    /// Number of threads.
    fn threads(&self) -> usize;

    /// The same device with `threads` threads of its own. Both share what is known of the latest
    /// sweeps.
    ///
    /// # Errors
    /// [`BackendError::Threads`] if the operating system cannot start the threads.
    fn beside(&self, threads: usize) -> Result<Self, BackendError>;

    /// Whether the device is lost.
    fn is_lost(&self) -> bool;

    /// Closes the device.
    fn destroy(&self);
}

impl Threaded for CpuBackend {
    fn threads(&self) -> usize {
        CpuBackend::threads(self)
    }

    fn beside(&self, threads: usize) -> Result<Self, BackendError> {
        CpuBackend::beside(self, threads)
    }

    fn is_lost(&self) -> bool {
        false
    }

    /// The threads end when the last lane drops its pool.
    fn destroy(&self) {}
}

/// A device with thread pools of several sizes.
pub(super) struct SharedThreads<B> {
    threads: usize,
    lanes: usize,
    /// The device with each of the pools. The first has all threads. A pool that only this list holds
    /// is idle.
    pools: Mutex<Vec<Arc<B>>>,
}

impl<B: Threaded> SharedThreads<B> {
    /// The threads of `whole`, for pairs on `lanes` lanes.
    pub(super) fn new(whole: B, lanes: usize) -> Self {
        Self {
            threads: whole.threads(),
            lanes,
            pools: Mutex::new(vec![Arc::new(whole)]),
        }
    }

    /// The device with all threads.
    fn whole(&self) -> Arc<B> {
        let pools = self.pools.lock().unwrap_or_else(PoisonError::into_inner);
        Arc::clone(&pools[0])
    }
}

impl<B: Threaded> Opened for SharedThreads<B> {
    /// A pool with the share of the threads that the pairs at work leave. If the operating system
    /// cannot start its threads, the pool with all threads.
    fn lane(&self) -> Arc<dyn Backend> {
        let mut pools = self.pools.lock().unwrap_or_else(PoisonError::into_inner);
        let is_idle = |pool: &Arc<B>| Arc::strong_count(pool) == 1;
        let busy = pools.iter().filter(|pool| !is_idle(pool)).count();
        let threads = share(self.threads, busy);
        let suits = |pool: &Arc<B>| is_idle(pool) && pool.threads() == threads;
        if let Some(pool) = pools.iter().find(|pool| suits(pool)) {
            return Arc::<B>::clone(pool);
        }
        let pool = match pools[0].beside(threads) {
            Ok(pool) => Arc::new(pool),
            Err(error) => {
                tracing::warn!(%error, threads, "a pair shares the threads of others");
                return Arc::<B>::clone(&pools[0]);
            }
        };
        if pools.len() > self.lanes {
            let mut place = 0;
            pools.retain(|pool| {
                place += 1;
                place == 1 || !is_idle(pool)
            });
        }
        pools.push(Arc::clone(&pool));
        pool
    }

    fn is_lost(&self) -> bool {
        self.whole().is_lost()
    }

    fn destroy(&self) {
        self.whole().destroy();
    }
}

/// The threads of a pair beside `busy` others. Halves of halves, so that a few sizes of pools serve.
fn share(threads: usize, busy: usize) -> usize {
    (threads / (busy + 1).next_power_of_two()).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cpu(threads: usize, lanes: usize) -> SharedThreads<CpuBackend> {
        let whole = CpuBackend::new(Some(threads)).expect("threads");
        SharedThreads::new(whole, lanes)
    }

    #[test]
    fn a_pair_alone_has_all_threads_and_others_a_share_of_them() {
        let shares: Vec<_> = (0..9).map(|busy| share(16, busy)).collect();
        assert_eq!(shares, [16, 8, 4, 4, 2, 2, 2, 2, 1]);
        assert_eq!([share(6, 1), share(1, 5)], [3, 1]);
        let shared = cpu(4, 3);
        let name = |lane: &Arc<dyn Backend>| lane.name();
        let first = shared.lane();
        assert!(name(&first).contains("4 threads"), "{}", name(&first));
        let [second, third] = [(); 2].map(|()| shared.lane());
        assert!(name(&second).contains("2 threads"), "{}", name(&second));
        assert!(name(&third).contains("1 thread"), "{}", name(&third));
        drop((first, second, third));
        assert!(name(&shared.lane()).contains("4 threads"));
    }

    #[test]
    fn idle_pools_do_not_pile_up() {
        let shared = cpu(8, 2);
        for round in 1..6 {
            let lanes: Vec<_> = (0..round % 4).map(|_| shared.lane()).collect();
            drop(lanes);
        }
        let pools = shared.pools.lock().expect("no test panics in it");
        assert!(pools.len() <= 4, "{}", pools.len());
    }
}
