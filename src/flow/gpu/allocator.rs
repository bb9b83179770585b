//! Allocator of the GPU's store: the buffer that holds the pairs' prepared targets and points.
//!
//! Sizes and offsets are in 32-bit words. Requests are served in order of arrival.

use core::time::Duration;
use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use crate::flow::data::locked;
use crate::flow::data::{Control, control};
use crate::flow::field::BackendError;

/// Longest wait of a request, counting only polling intervals in which no words were released.
const PATIENCE: Duration = Duration::from_secs(20);
/// Interval at which a waiting request checks its control.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// First-fit allocator with a queue of waiting requests.
#[derive(Debug)]
pub(super) struct Allocator {
    store: Mutex<Store>,
    /// Signals that words were released or a request has left the queue.
    moved: Condvar,
    all: u64,
}

#[derive(Debug)]
struct Store {
    /// Free ranges: offset and length, ordered by offset.
    free: Vec<(u64, u64)>,
    /// Tickets of the waiting requests, oldest first. Only the first is served; otherwise many
    /// small pairs could block a large one for ever.
    line: VecDeque<u64>,
    /// The next ticket.
    next: u64,
}

impl Store {
    /// Takes `count` words from the first free range that is large enough, and returns their
    /// offset.
    fn taken(&mut self, count: u64) -> Option<u64> {
        let stretch = self.free.iter_mut().find(|(_, length)| *length >= count)?;
        let index = stretch.0;
        *stretch = (index + count, stretch.1 - count);
        self.free.retain(|&(_, length)| length > 0);
        Some(index)
    }
}

/// A request's place in the queue, until it is dropped.
struct Place<'a> {
    allocator: &'a Allocator,
    ticket: u64,
}

impl Drop for Place<'_> {
    fn drop(&mut self) {
        let mut store = self.allocator.store();
        store.line.retain(|&other| other != self.ticket);
        self.allocator.moved.notify_all();
    }
}

impl Allocator {
    pub(super) fn new(words: u64) -> Self {
        Self {
            store: Mutex::new(Store {
                free: vec![(0, words)],
                line: VecDeque::new(),
                next: 0,
            }),
            moved: Condvar::new(),
            all: words,
        }
    }

    fn store(&self) -> MutexGuard<'_, Store> {
        locked(&self.store)
    }

    /// Allocates `count` words and returns their offset. Waits for other pairs to release theirs.
    ///
    /// # Errors
    /// [`BackendError::Memory`] if the store is smaller than `count` words. [`BackendError::Busy`]
    /// if too few words are released in time. [`BackendError::Interrupted`] if the control
    /// interrupts.
    pub(super) fn take(
        &self,
        what: &'static str,
        count: u64,
        control: &dyn Control,
    ) -> Result<u64, BackendError> {
        if count > self.all {
            return Err(BackendError::Memory {
                what,
                needed: count * 4,
                available: self.all * 4,
            });
        }
        let place = self.place_in_line();
        let mut waited = Duration::ZERO;
        let mut store = self.store();
        loop {
            if store.line.front() == Some(&place.ticket)
                && let Some(index) = store.taken(count)
            {
                return Ok(index);
            }
            if waited >= PATIENCE {
                return Err(BackendError::Busy);
            }
            let (woken, timeout) = self
                .moved
                .wait_timeout(store, POLL_INTERVAL)
                .unwrap_or_else(PoisonError::into_inner);
            drop(woken);
            if timeout.timed_out() {
                waited += POLL_INTERVAL;
            }
            control::check(control).map_err(BackendError::Interrupted)?;
            store = self.store();
        }
    }

    /// A place at the end of the queue.
    fn place_in_line(&self) -> Place<'_> {
        let mut store = self.store();
        let ticket = store.next;
        store.next += 1;
        store.line.push_back(ticket);
        Place {
            allocator: self,
            ticket,
        }
    }

    /// Releases `count` words at offset `index`.
    pub(super) fn give_back(&self, index: u64, count: u64) {
        if count == 0 {
            return;
        }
        let mut store = self.store();
        store.free.push((index, count));
        store.free.sort_unstable();
        let mut joined: Vec<(u64, u64)> = Vec::with_capacity(store.free.len());
        for &(index, length) in &store.free {
            match joined.last_mut() {
                Some(last) if last.0 + last.1 == index => last.1 += length,
                _ => joined.push((index, length)),
            }
        }
        store.free = joined;
        self.moved.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::panic::catch_unwind;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::*;
    use crate::flow::data::{Interrupt, Uncontrolled};

    /// Interrupts at the first check.
    struct Over;

    impl Control for Over {
        fn interrupt(&self) -> Option<Interrupt> {
            Some(Interrupt::Deadline)
        }
    }

    #[test]
    fn words_given_back_can_be_taken_again_in_one_piece() {
        let words = Allocator::new(100);
        let take = |count| words.take("points", count, &Uncontrolled).expect("free");
        let [a, b, c] = [take(30), take(30), take(40)];
        words.give_back(a, 30);
        words.give_back(c, 40);
        words.give_back(b, 30);
        assert_eq!(take(100), 0);
    }

    #[test]
    fn what_never_fits_is_refused_at_once_and_what_is_taken_is_waited_for() {
        let words = Allocator::new(100);
        let refused = words.take("points", 101, &Uncontrolled);
        assert!(matches!(
            refused,
            Err(BackendError::Memory { needed: 404, .. })
        ));
        words.take("points", 60, &Uncontrolled).expect("free");
        let interrupted = words.take("points", 60, &Over);
        assert!(matches!(interrupted, Err(BackendError::Interrupted(_))));
    }

    #[test]
    fn a_request_whose_control_panics_leaves_the_line() {
        struct Panics;
        impl Control for Panics {
            fn interrupt(&self) -> Option<Interrupt> {
                unreachable!("as a control of a caller may")
            }
        }
        let words = Allocator::new(100);
        let taken = words.take("points", 60, &Uncontrolled).expect("free");
        let panicked = catch_unwind(|| words.take("points", 80, &Panics));
        assert!(panicked.is_err());
        words.take("points", 40, &Over).expect("the line is empty");
        words.give_back(taken, 60);
    }

    #[test]
    fn who_asks_for_little_does_not_pass_who_waits_for_much() {
        /// Records that it was checked.
        #[derive(Default)]
        struct Waits(AtomicBool);
        impl Control for Waits {
            fn interrupt(&self) -> Option<Interrupt> {
                self.0.store(true, Ordering::Relaxed);
                None
            }
        }
        let (words, waits) = (Allocator::new(100), Waits::default());
        let taken = words.take("points", 60, &Uncontrolled).expect("free");
        std::thread::scope(|scope| {
            let large = scope.spawn(|| words.take("points", 80, &waits));
            while !waits.0.load(Ordering::Relaxed) {
                std::thread::yield_now();
            }
            // 40 words are free.
            let small = words.take("points", 10, &Over);
            assert!(matches!(small, Err(BackendError::Interrupted(_))));
            words.give_back(taken, 60);
            let index = large.join().expect("no panic").expect("its turn");
            assert_eq!(index, 0);
        });
        // A request that has left the queue blocks no other.
        assert_eq!(words.take("points", 20, &Uncontrolled).expect("free"), 80);
    }
}
