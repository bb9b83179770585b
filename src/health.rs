//! Inputs of the liveness and readiness probes besides the devices: heartbeats of background loops,
//! and the health of the store.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use crate::storage::FreeSpace;
use crate::sync::locked;

/// Interval at which a loop updates its heartbeat.
pub const HEARTBEAT: Duration = Duration::from_secs(1);

/// The heartbeat of a background loop. Its creation counts as the first update.
#[derive(Debug)]
pub struct Heartbeat {
    began: Instant,
    last: AtomicU64,
}

impl Default for Heartbeat {
    fn default() -> Self {
        Self {
            began: Instant::now(),
            last: AtomicU64::new(0),
        }
    }
}

impl Heartbeat {
    fn millis(&self) -> u64 {
        u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX)
    }

    /// Records that the loop is alive.
    pub fn beat(&self) {
        self.last.store(self.millis(), Ordering::Relaxed);
    }

    /// A heartbeat whose last update is this long ago.
    #[cfg(test)]
    pub(crate) fn silent_for(silence: Duration) -> Self {
        Self {
            began: Instant::now() - silence,
            last: AtomicU64::new(0),
        }
    }

    /// Time since the last update.
    pub fn age(&self) -> Duration {
        let last = self.last.load(Ordering::Relaxed);
        Duration::from_millis(self.millis().saturating_sub(last))
    }
}

/// Health of the store: the queue and the blobs. Its users report failures, and a probe reports
/// the recovery. While the store fails, workers lease no jobs. A new record is healthy.
#[derive(Debug, Default)]
pub struct StoreHealth {
    trouble: watch::Sender<Option<String>>,
    /// Free space, and the time of its measurement.
    free: Mutex<Option<(Instant, FreeSpace)>>,
    needed: AtomicU64,
}

impl StoreHealth {
    /// Records a failure of the store that no job caused. `error` becomes the message of
    /// [`StoreHealth::trouble`].
    pub fn failed(&self, error: &dyn std::fmt::Display) {
        let new = self.trouble.send_replace(Some(error.to_string())).is_none();
        if new {
            tracing::error!(%error, "the store has failed: no job is taken until it works again");
        }
    }

    /// Records that a write of `bytes` bytes found no space. The largest such size since the last
    /// recovery counts. The store recovers only with twice this much free space, at least 4 MiB.
    pub fn needs(&self, bytes: u64) {
        self.needed.fetch_max(bytes, Ordering::Relaxed);
    }

    /// The largest write that found no space since the last recovery, bytes; 0 if none.
    pub fn needed(&self) -> u64 {
        self.needed.load(Ordering::Relaxed)
    }

    /// Records that a probe has written and read the store. Resets [`StoreHealth::needed`] to 0.
    pub fn works(&self) {
        self.needed.store(0, Ordering::Relaxed);
        if self.trouble.send_replace(None).is_some() {
            tracing::info!("the store works again");
        }
    }

    /// Records the measured free space.
    pub fn has_free(&self, free: FreeSpace) {
        *locked(&self.free) = Some((Instant::now(), free));
    }

    /// The age of the last measurement of free space, and its result; `None` before the first one.
    pub fn free(&self) -> Option<(Duration, FreeSpace)> {
        let free = *locked(&self.free);
        free.map(|(looked, free)| (looked.elapsed(), free))
    }

    /// The message of the current failure; `None` while the store works.
    pub fn trouble(&self) -> Option<String> {
        self.trouble.borrow().clone()
    }

    /// Waits until the store works. Returns at once if it works now.
    pub async fn until_it_works(&self) {
        let mut trouble = self.trouble.subscribe();
        let _the_sender_is_here = trouble.wait_for(Option::is_none).await;
    }

    /// Waits until the store fails. Returns at once if it fails now.
    pub async fn until_it_fails(&self) {
        let mut trouble = self.trouble.subscribe();
        let _the_sender_is_here = trouble.wait_for(Option::is_some).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn who_waits_for_the_store_goes_on_when_it_works() {
        let store = StoreHealth::default();
        store.until_it_works().await;
        store.failed(&"no space");
        assert_eq!(store.trouble().as_deref(), Some("no space"));
        store.until_it_fails().await;
        let waiting = tokio::time::timeout(Duration::from_millis(20), store.until_it_works());
        assert!(waiting.await.is_err());
        store.works();
        store.until_it_works().await;
        assert_eq!(store.trouble(), None);
    }

    #[test]
    fn a_loop_that_goes_on_is_young() {
        let heartbeat = Heartbeat::default();
        std::thread::sleep(Duration::from_millis(30));
        assert!(heartbeat.age() >= Duration::from_millis(30));
        heartbeat.beat();
        assert!(heartbeat.age() < Duration::from_millis(30));
    }
}
