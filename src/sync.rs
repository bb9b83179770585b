//! Locks for the modules of the service.

use std::sync::{Arc, PoisonError, RwLock};

pub(crate) use crate::flow::locked;

/// A value that can be exchanged while others use it.
#[derive(Debug)]
pub(crate) struct Exchange<T>(RwLock<Arc<T>>);

impl<T> Exchange<T> {
    pub(crate) fn new(value: T) -> Self {
        Self(RwLock::new(Arc::new(value)))
    }

    /// The value of this moment.
    pub(crate) fn get(&self) -> Arc<T> {
        Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }

    /// Exchanges the value for those who ask from now on.
    pub(crate) fn set(&self, value: T) {
        *self.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(value);
    }
}
