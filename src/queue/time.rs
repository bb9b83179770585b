//! The clocks of the queue: wall-clock time for what is stored, monotonic time for leases.
//!
//! The simulation sets both for its thread.

#[cfg(any(test, feature = "fuzzing"))]
pub(super) use simulated::{monotonic, set, wall};
#[cfg(not(any(test, feature = "fuzzing")))]
pub(super) use system::{monotonic, wall};

#[cfg(not(any(test, feature = "fuzzing")))]
mod system {
    use std::time::Instant;

    use crate::clock::Timestamp;

    /// The time for rows.
    pub(in crate::queue) fn wall() -> Timestamp {
        Timestamp::now()
    }

    /// The time for leases, which no setting of the system's clock changes.
    pub(in crate::queue) fn monotonic() -> Instant {
        Instant::now()
    }
}

#[cfg(any(test, feature = "fuzzing"))]
mod simulated {
    use std::cell::Cell;
    use std::time::Instant;

    use crate::clock::Timestamp;

    thread_local! {
        static TIMES: Cell<Option<(Timestamp, Instant)>> = const { Cell::new(None) };
    }

    /// Sets both clocks for this thread.
    pub(in crate::queue) fn set(wall: Timestamp, monotonic: Instant) {
        TIMES.set(Some((wall, monotonic)));
    }

    pub(in crate::queue) fn wall() -> Timestamp {
        TIMES.get().map_or_else(Timestamp::now, |(wall, _)| wall)
    }

    pub(in crate::queue) fn monotonic() -> Instant {
        TIMES
            .get()
            .map_or_else(Instant::now, |(_, monotonic)| monotonic)
    }
}
