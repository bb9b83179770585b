//! What is found when it is first asked for. It must not know what that is.

use std::sync::OnceLock;

/// What a lock holds, found first where it holds nothing. Not inside of the lock: who waits for a
/// thread there may be given work that needs the same.
pub(crate) fn found<T>(lock: &OnceLock<T>, find: impl FnOnce() -> T) -> &T {
    if let Some(found) = lock.get() {
        return found;
    }
    let new = find();
    lock.get_or_init(|| new)
}
