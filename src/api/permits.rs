//! Fair permits for scarce resources, shared by tenants.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::error::ApiError;
use crate::job::Tenant;
use crate::sync::locked;

/// A waiting line for permits. Each key, which is a tenant if nothing else is said, can have only a
/// bounded number of its requests in the shared line. So a tenant with many requests does not delay the
/// others by all of them.
pub(super) struct FairQueue<K = Tenant> {
    each: usize,
    all: Arc<Semaphore>,
    own: Mutex<HashMap<K, Weak<Semaphore>>>,
}

impl<K: Clone + Eq + Hash> FairQueue<K> {
    /// `turns` permits. Each tenant may have up to `each` requests that hold one or are in the shared
    /// line. Where a permit is held for long, that is fewer than there are permits.
    pub(super) fn new(turns: usize, each: usize) -> Self {
        Self {
            each,
            all: Arc::new(Semaphore::new(turns.min(Semaphore::MAX_PERMITS))),
            own: Mutex::default(),
        }
    }

    /// Waits for a permit for the tenant. The permit is held until the returned value is dropped.
    pub(super) async fn wait(&self, tenant: &K) -> Option<[OwnedSemaphorePermit; 2]> {
        let own = {
            let mut own = locked(&self.own);
            own.retain(|_, line| line.strong_count() > 0);
            let known = own.get(tenant).and_then(Weak::upgrade);
            known.unwrap_or_else(|| {
                let line = Arc::new(Semaphore::new(self.each));
                own.insert(tenant.clone(), Arc::downgrade(&line));
                line
            })
        };
        let own = own.acquire_owned().await.ok()?;
        let all = Arc::clone(&self.all).acquire_owned().await.ok()?;
        Some([own, all])
    }
}

/// Permits that are granted or refused at once. With several tenants, each may hold at most half of
/// them.
pub(super) struct TenantPermits {
    most: usize,
    share: usize,
    held: Mutex<HashMap<Tenant, usize>>,
}

/// One permit, released when dropped.
pub(super) struct TenantPermit {
    turns: Arc<TenantPermits>,
    tenant: Tenant,
}

impl TenantPermits {
    /// `most` permits. With `several` tenants, each tenant may hold at most half of them.
    pub(super) fn new(most: usize, several: bool) -> Self {
        Self {
            most,
            share: if several { most / 2 } else { most },
            held: Mutex::default(),
        }
    }

    fn held(&self) -> MutexGuard<'_, HashMap<Tenant, usize>> {
        locked(&self.held)
    }

    /// Takes a permit for a tenant.
    ///
    /// # Errors
    /// [`ApiError::ServerFull`] if all permits are taken, or the tenant holds its full share.
    pub(super) fn take(self: &Arc<Self>, tenant: &Tenant) -> Result<TenantPermit, ApiError> {
        let mut held = self.held();
        let all: usize = held.values().sum();
        let own = held.get(tenant).copied().unwrap_or(0);
        if all >= self.most || own >= self.share {
            return Err(ApiError::ServerFull(Duration::from_secs(1)));
        }
        *held.entry(tenant.clone()).or_default() += 1;
        Ok(TenantPermit {
            turns: Arc::clone(self),
            tenant: tenant.clone(),
        })
    }
}

impl Drop for TenantPermit {
    fn drop(&mut self) {
        let mut held = self.turns.held();
        if let Some(own) = held.get_mut(&self.tenant) {
            *own -= 1;
            if *own == 0 {
                held.remove(&self.tenant);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn nobody_waits_for_all_that_another_tenant_has_asked_for() {
        let tenant = |name: &str| name.parse::<Tenant>().expect("a good name");
        let line = Arc::new(FairQueue::new(1, 1));
        let first = line.wait(&tenant("many")).await;
        let done = Arc::new(Mutex::new(Vec::new()));
        let mut waiting = tokio::task::JoinSet::new();
        for name in ["many", "many", "many", "few", "many"] {
            let (line, done) = (Arc::clone(&line), Arc::clone(&done));
            waiting.spawn(async move {
                let _turn = line.wait(&tenant(name)).await;
                done.lock().expect("no panic").push(name);
            });
            tokio::task::yield_now().await;
        }
        drop(first);
        while waiting.join_next().await.is_some() {}
        let done = done.lock().expect("no panic").clone();
        let index = done.iter().position(|name| *name == "few");
        assert!(index.is_some_and(|index| index <= 1), "{done:?}");
    }

    #[tokio::test]
    async fn a_tenant_that_holds_its_permits_for_long_leaves_some_to_others() {
        let tenant = |name: &str| name.parse::<Tenant>().expect("a good name");
        let line = FairQueue::new(4, 2);
        let _held = [
            line.wait(&tenant("many")).await,
            line.wait(&tenant("many")).await,
        ];
        let soon = Duration::from_millis(20);
        let more = tokio::time::timeout(soon, line.wait(&tenant("many"))).await;
        assert!(more.is_err());
        let other = tokio::time::timeout(Duration::from_secs(20), line.wait(&tenant("few"))).await;
        assert!(other.expect("at once").is_some());
    }

    #[test]
    fn one_of_several_tenants_leaves_the_others_half() {
        let tenant = |name: &str| name.parse::<Tenant>().expect("a good name");
        let turns = Arc::new(TenantPermits::new(4, true));
        let first = [(); 2].map(|()| turns.take(&tenant("a")).expect("a turn"));
        assert!(turns.take(&tenant("a")).is_err());
        let second = [(); 2].map(|()| turns.take(&tenant("b")).expect("a turn"));
        assert!(turns.take(&tenant("c")).is_err());
        drop(first);
        drop(turns.take(&tenant("c")).expect("a turn"));
        drop(second);
        assert!(turns.held().is_empty());
        let alone = Arc::new(TenantPermits::new(2, false));
        let _both = [(); 2].map(|()| alone.take(&tenant("a")).expect("a turn"));
        assert!(alone.take(&tenant("a")).is_err());
    }
}
