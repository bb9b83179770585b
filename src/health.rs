//! What liveness and readiness look at besides the devices: loops that go on, and a store that
//! can be written. It must not know what a loop does or where the store lies.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use crate::storage::FreeSpace;

/// How often a loop gives a sign of life.
pub const HEARTBEAT: Duration = Duration::from_secs(1);

/// A loop's sign of life.
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

    /// The loop goes on.
    pub fn beat(&self) {
        self.last.store(self.millis(), Ordering::Relaxed);
    }

    /// As if the last sign of life were so old.
    #[cfg(test)]
    pub(crate) fn silent_for(silence: Duration) -> Self {
        Self {
            began: Instant::now() - silence,
            last: AtomicU64::new(0),
        }
    }

    /// Time since the last sign of life.
    pub fn age(&self) -> Duration {
        let last = self.last.load(Ordering::Relaxed);
        Duration::from_millis(self.millis().saturating_sub(last))
    }
}

/// Whether the store can be read and written. Users of the store report failures; the probe reports
/// recovery. Workers lease no job while the store fails.
#[derive(Debug, Default)]
pub struct StoreHealth {
    trouble: watch::Sender<Option<String>>,
    /// What could still be written, and when that was looked at.
    free: Mutex<Option<(Instant, FreeSpace)>>,
    needed: AtomicU64,
}

impl StoreHealth {
    /// The store has failed, through no fault of a job.
    pub fn failed(&self, error: &dyn std::fmt::Display) {
        let new = self.trouble.send_replace(Some(error.to_string())).is_none();
        if new {
            tracing::error!(%error, "the store has failed: no job is taken until it works again");
        }
    }

    /// There was no room for so many bytes: without it the store does not work again.
    pub fn needs(&self, bytes: u64) {
        self.needed.fetch_max(bytes, Ordering::Relaxed);
    }

    /// Bytes that there has to be room for.
    pub fn needed(&self) -> u64 {
        self.needed.load(Ordering::Relaxed)
    }

    /// A probe has written and read.
    pub fn works(&self) {
        self.needed.store(0, Ordering::Relaxed);
        if self.trouble.send_replace(None).is_some() {
            tracing::info!("the store works again");
        }
    }

    /// So much can still be written.
    pub fn has_free(&self, free: FreeSpace) {
        *self.free.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), free));
    }

    /// What could still be written at the last look, and its age; none before the first.
    pub fn free(&self) -> Option<(Duration, FreeSpace)> {
        let free = *self.free.lock().unwrap_or_else(PoisonError::into_inner);
        free.map(|(looked, free)| (looked.elapsed(), free))
    }

    /// What is wrong, if anything is.
    pub fn trouble(&self) -> Option<String> {
        self.trouble.borrow().clone()
    }

    /// Returns when nothing is wrong.
    pub async fn until_it_works(&self) {
        let mut trouble = self.trouble.subscribe();
        let _the_sender_is_here = trouble.wait_for(Option::is_none).await;
    }

    /// Returns when something is wrong.
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
