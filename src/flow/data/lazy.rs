//! Lazily computed values.

use std::sync::OnceLock;

/// The value in `cell`, computed on first use. It is computed outside of the cell's initialization:
/// a pool thread waiting inside for its subtasks could steal a task that waits for the same cell.
/// Several threads may compute the value; the first one stored is kept.
pub(crate) fn get_or_compute<T>(cell: &OnceLock<T>, compute: impl FnOnce() -> T) -> &T {
    if let Some(found) = cell.get() {
        return found;
    }
    let new = compute();
    cell.get_or_init(|| new)
}
