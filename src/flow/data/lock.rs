//! Locks whose data stay sound when a holder panics.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// The guard of a lock, whether or not an earlier holder panicked: only for data that are sound
/// between any two statements of their holders.
pub(crate) fn locked<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
