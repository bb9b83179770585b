//! Values that are computed when they are first asked for.

use std::sync::OnceLock;

/// The value in `cell`, computed first where there is none. It is computed outside of the cell: a
/// thread that waits in there could be given work that waits for the same cell.
pub(crate) fn get_or_compute<T>(cell: &OnceLock<T>, compute: impl FnOnce() -> T) -> &T {
    if let Some(found) = cell.get() {
        return found;
    }
    let new = compute();
    cell.get_or_init(|| new)
}
