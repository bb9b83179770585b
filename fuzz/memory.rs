//! An allocator that counts, and ends the process where an input takes more memory than its target
//! allows: bad input must cost nothing.

#![expect(unsafe_code, reason = "an allocator is unsafe by its interface")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Write;
use std::sync::atomic::{AtomicIsize, Ordering::Relaxed};

/// The system's allocator, with a limit.
pub(crate) struct Counting;

static LIVE: AtomicIsize = AtomicIsize::new(0);
static LIMIT: AtomicIsize = AtomicIsize::new(isize::MAX);

/// Allows `bytes` more than there are now, in all threads, until the next call.
pub(crate) fn allow(bytes: usize) {
    LIMIT.store(isize::MAX, Relaxed);
    let limit = LIVE.load(Relaxed).saturating_add_unsigned(bytes);
    LIMIT.store(limit, Relaxed);
}

/// Runs `report` without a limit. What it keeps does not count against the input.
pub(crate) fn uncounted(report: impl FnOnce()) {
    let limit = LIMIT.swap(isize::MAX, Relaxed);
    let before = LIVE.load(Relaxed);
    report();
    let kept = LIVE.load(Relaxed) - before;
    LIMIT.store(limit.saturating_add(kept), Relaxed);
}

fn count(bytes: isize) {
    let live = LIVE.fetch_add(bytes, Relaxed) + bytes;
    if live > LIMIT.load(Relaxed) {
        // What follows allocates, too.
        LIMIT.store(isize::MAX, Relaxed);
        // Not by the macro, whose output a test keeps to itself.
        let _written = writeln!(
            std::io::stderr(),
            "the input takes more memory than its target allows: {bytes} bytes were asked for"
        );
        std::process::abort();
    }
}

// SAFETY: every call goes to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        LIVE.fetch_sub(layout.size() as isize, Relaxed);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size as isize - layout.size() as isize);
        // SAFETY: the caller's promise is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}
