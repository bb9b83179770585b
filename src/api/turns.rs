//! Turns at something of which there are few: one of several tenants has half of them.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::error::ApiError;
use crate::job::Tenant;

/// Turns of all tenants.
pub(super) struct Turns {
    most: usize,
    share: usize,
    held: Mutex<HashMap<Tenant, usize>>,
}

/// One turn, until it is dropped.
pub(super) struct Turn {
    turns: Arc<Turns>,
    tenant: Tenant,
}

impl Turns {
    /// So many turns, which `several` tenants may share.
    pub(super) fn new(most: usize, several: bool) -> Self {
        Self {
            most,
            share: if several { most / 2 } else { most },
            held: Mutex::default(),
        }
    }

    fn held(&self) -> MutexGuard<'_, HashMap<Tenant, usize>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A turn of a tenant.
    ///
    /// # Errors
    /// [`ApiError::ServerFull`] where all are taken, or all that the tenant may have.
    pub(super) fn take(self: &Arc<Self>, tenant: &Tenant) -> Result<Turn, ApiError> {
        let mut held = self.held();
        let all: usize = held.values().sum();
        let own = held.get(tenant).copied().unwrap_or(0);
        if all >= self.most || own >= self.share {
            return Err(ApiError::ServerFull(Duration::from_secs(1)));
        }
        *held.entry(tenant.clone()).or_default() += 1;
        Ok(Turn {
            turns: Arc::clone(self),
            tenant: tenant.clone(),
        })
    }
}

impl Drop for Turn {
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

    #[test]
    fn one_of_several_tenants_leaves_the_others_half() {
        let tenant = |name: &str| name.parse::<Tenant>().expect("a good name");
        let turns = Arc::new(Turns::new(4, true));
        let first = [(); 2].map(|()| turns.take(&tenant("a")).expect("a turn"));
        assert!(turns.take(&tenant("a")).is_err());
        let second = [(); 2].map(|()| turns.take(&tenant("b")).expect("a turn"));
        assert!(turns.take(&tenant("c")).is_err());
        drop(first);
        drop(turns.take(&tenant("c")).expect("a turn"));
        drop(second);
        assert!(turns.held().is_empty());
        let alone = Arc::new(Turns::new(2, false));
        let _both = [(); 2].map(|()| alone.take(&tenant("a")).expect("a turn"));
        assert!(alone.take(&tenant("a")).is_err());
    }
}
