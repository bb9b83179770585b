//! Requests of several threads that share a submission, which one of the waiting threads makes.
//!
//! The driver runs one submission after another. A submission of one small pair leaves a large GPU
//! idle, so requests that wait while one runs share the next one.

use core::ops::ControlFlow;
use core::time::Duration;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::health::Watchdog;
use crate::flow::data::locked;
use crate::flow::field::BackendError;

/// How long the submitting thread waits for further requests.
const BATCHING_WINDOW: Duration = Duration::from_micros(300);
/// Interval at which a waiting thread asks whether it is over.
const CHECK_INTERVAL: Duration = Duration::from_millis(200);

/// A request with its ticket.
pub(super) type Ticketed<R> = (u64, R);

/// How requests are submitted.
pub(super) trait Submit<R, D> {
    /// Whether further requests are expected at once.
    fn expects_more(&self, _waiting: &[Ticketed<R>]) -> bool {
        false
    }

    /// Takes the requests of the next submission out of the queue: one at least, of one at least.
    fn take(&self, waiting: &mut Vec<Ticketed<R>>) -> Vec<Ticketed<R>>;

    /// Submits the requests. Returns one result for each of them, in their order.
    ///
    /// # Errors
    /// [`BackendError`] if the GPU fails.
    fn submit(&self, requests: &[&R]) -> Result<Vec<D>, BackendError>;
}

/// The queue of the requests of one kind.
pub(super) struct Shared<R, D> {
    state: Mutex<State<R, D>>,
    changed: Condvar,
}

struct State<R, D> {
    next_ticket: u64,
    waiting: Vec<Ticketed<R>>,
    done: HashMap<u64, Result<D, BackendError>>,
    /// Whether a thread is submitting.
    submitting: bool,
}

impl<R, D> Default for Shared<R, D> {
    fn default() -> Self {
        Self {
            state: Mutex::new(State {
                next_ticket: 0,
                waiting: Vec::new(),
                done: HashMap::new(),
                submitting: false,
            }),
            changed: Condvar::new(),
        }
    }
}

impl<R, D> Shared<R, D> {
    /// Tells a thread that waits for further requests that fewer are expected.
    pub(super) fn expect_fewer(&self) {
        // The thread holds the lock from its look at what is expected until it sleeps.
        drop(locked(&self.state));
        self.changed.notify_all();
    }

    /// Has the request submitted, together with those that other threads make meanwhile. Asks
    /// `is_over` every 200 ms while others are submitted, which also shows that the pair is alive.
    /// Breaks with its answer if there is one before the request is submitted.
    ///
    /// # Errors
    /// [`BackendError`] if the GPU fails.
    pub(super) fn run<O>(
        &self,
        watchdog: &Watchdog,
        request: R,
        how: &impl Submit<R, D>,
        is_over: &dyn Fn() -> Option<O>,
    ) -> Result<ControlFlow<O, D>, BackendError> {
        let mut state = locked(&self.state);
        let ticket = state.next_ticket;
        state.next_ticket += 1;
        state.waiting.push((ticket, request));
        self.changed.notify_all();
        loop {
            state = if state.submitting {
                self.waited(state, ticket)
            } else {
                self.submitted(state, watchdog, how)
            };
            if !state.done.contains_key(&ticket) {
                drop(state);
                let over = catch_unwind(AssertUnwindSafe(is_over));
                state = locked(&self.state);
                match over {
                    Ok(Some(over)) if state.withdraw(ticket) => {
                        return Ok(ControlFlow::Break(over));
                    }
                    Ok(_) => {}
                    Err(panic) => {
                        // The caller frees the buffers of the request, so it must not be submitted later.
                        while !state.withdraw(ticket) && state.done.remove(&ticket).is_none() {
                            state = self.waited(state, ticket);
                        }
                        drop(state);
                        resume_unwind(panic);
                    }
                }
            }
            if let Some(done) = state.done.remove(&ticket) {
                return done.map(ControlFlow::Continue);
            }
        }
    }

    /// Waits while another thread submits, until the ticket's request is done, or for a while.
    fn waited<'a>(
        &'a self,
        state: MutexGuard<'a, State<R, D>>,
        ticket: u64,
    ) -> MutexGuard<'a, State<R, D>> {
        let waits = |state: &mut State<R, D>| state.submitting && !state.done.contains_key(&ticket);
        let waited = self
            .changed
            .wait_timeout_while(state, CHECK_INTERVAL, waits);
        waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Submits the next requests, of all threads, and keeps what was done for each.
    fn submitted<'a>(
        &'a self,
        mut state: MutexGuard<'a, State<R, D>>,
        watchdog: &Watchdog,
        how: &impl Submit<R, D>,
    ) -> MutexGuard<'a, State<R, D>> {
        state.submitting = true;
        let incomplete = |state: &mut State<R, D>| how.expects_more(&state.waiting);
        state = self
            .changed
            .wait_timeout_while(state, BATCHING_WINDOW, incomplete)
            .unwrap_or_else(PoisonError::into_inner)
            .0;
        let taken = how.take(&mut state.waiting);
        drop(state);
        let requests: Vec<&R> = taken.iter().map(|(_, request)| request).collect();
        let submitted = watchdog.check().and_then(|()| {
            let submitted = catch_unwind(AssertUnwindSafe(|| how.submit(&requests)));
            submitted.unwrap_or_else(|_| {
                let reason = "the driver's bindings panicked".to_owned();
                watchdog.lost(reason.clone());
                Err(BackendError::Lost(reason))
            })
        });
        state = locked(&self.state);
        state.submitting = false;
        let tickets = taken.iter().map(|(ticket, _)| *ticket);
        match submitted {
            Ok(all) => state.done.extend(tickets.zip(all.into_iter().map(Ok))),
            Err(error) => {
                let each = tickets.map(|ticket| (ticket, Err(error_of_each(watchdog, &error))));
                state.done.extend(each);
            }
        }
        self.changed.notify_all();
        state
    }
}

/// What a failed submission is to each of its requests.
fn error_of_each(watchdog: &Watchdog, error: &BackendError) -> BackendError {
    match (watchdog.check(), error) {
        (Err(lost), _) => lost,
        (Ok(()), BackendError::Busy) => BackendError::Busy,
        (Ok(()), BackendError::Unsupported(what)) => BackendError::Unsupported(what),
        (
            Ok(()),
            &BackendError::Memory {
                what,
                needed,
                available,
            },
        ) => BackendError::Memory {
            what,
            needed,
            available,
        },
        (Ok(()), BackendError::Device(text)) => BackendError::Device(text.clone()),
        (Ok(()), error) => BackendError::Device(error.to_string()),
    }
}

impl<R, D> State<R, D> {
    /// Takes a request out of the queue. Returns false if it was submitted already.
    fn withdraw(&mut self, ticket: u64) -> bool {
        let before = self.waiting.len();
        self.waiting.retain(|(other, _)| *other != ticket);
        self.waiting.len() < before
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;
    use std::thread;

    use super::*;

    /// What a test's submissions do with a request of this number.
    const BUSY: u32 = 13;
    const PANIC: u32 = 14;

    /// Submits up to three requests together, and returns the number of them with each. Tells when a
    /// submission begins, and waits until it may end.
    struct Counted {
        began: mpsc::Sender<()>,
        may_end: Mutex<mpsc::Receiver<()>>,
    }

    impl Submit<u32, (u32, usize)> for Counted {
        fn take(&self, waiting: &mut Vec<Ticketed<u32>>) -> Vec<Ticketed<u32>> {
            waiting.drain(..waiting.len().min(3)).collect()
        }

        fn submit(&self, requests: &[&u32]) -> Result<Vec<(u32, usize)>, BackendError> {
            self.began.send(()).expect("a receiver");
            locked(&self.may_end).recv().expect("a sender");
            if requests.contains(&&BUSY) {
                return Err(BackendError::Busy);
            }
            assert!(!requests.contains(&&PANIC), "as the driver's bindings do");
            let of = |&&request: &&u32| (request, requests.len());
            Ok(requests.iter().map(of).collect())
        }
    }

    /// The submissions, what tells that one begins, and what lets one end.
    fn counted() -> (Counted, mpsc::Receiver<()>, mpsc::Sender<()>) {
        let (began, begins) = mpsc::channel();
        let (end, may_end) = mpsc::channel();
        let may_end = Mutex::new(may_end);
        (Counted { began, may_end }, begins, end)
    }

    type Ended = Result<ControlFlow<(), (u32, usize)>, BackendError>;

    /// Submits 0, and the three `others` while that runs. The first submission ends when they wait, and
    /// all later ones do at once. Returns how the others ended.
    fn submitted_beside(watchdog: &Watchdog, others: [u32; 3]) -> [Ended; 3] {
        let (how, begins, end) = counted();
        let shared = Shared::default();
        let run = |request: u32| -> Ended { shared.run(watchdog, request, &how, &|| None) };
        let ended = thread::scope(|scope| {
            let first = scope.spawn(|| run(0));
            begins.recv().expect("a submission");
            let run = &run;
            let others = others.map(|request| scope.spawn(move || run(request)));
            while locked(&shared.state).next_ticket < 4 {
                thread::yield_now();
            }
            for _ in 0..4 {
                end.send(()).expect("a receiver");
            }
            let first = first.join().expect("no panic").expect("no error");
            assert_eq!(first, ControlFlow::Continue((0, 1)));
            others.map(|other| other.join().expect("no panic"))
        });
        let state = locked(&shared.state);
        assert!(state.done.is_empty() && state.waiting.is_empty() && !state.submitting);
        ended
    }

    #[test]
    fn requests_that_come_while_another_is_submitted_share_the_next_submission() {
        let ended = submitted_beside(&Watchdog::default(), [1, 2, 3]);
        for (request, ended) in (1..).zip(ended) {
            let ended = ended.expect("no error");
            assert_eq!(ended, ControlFlow::Continue((request, 3)));
        }
    }

    #[test]
    fn a_submission_that_fails_fails_for_each_of_its_requests_and_for_no_other() {
        let ended = submitted_beside(&Watchdog::default(), [1, BUSY, 3]);
        for ended in ended {
            assert!(matches!(ended, Err(BackendError::Busy)), "{ended:?}");
        }
        let watchdog = Watchdog::default();
        let ended = submitted_beside(&watchdog, [1, PANIC, 3]);
        for ended in ended {
            assert!(matches!(ended, Err(BackendError::Lost(_))), "{ended:?}");
        }
        assert!(watchdog.check().is_err());
    }

    #[test]
    fn a_lack_of_memory_is_one_to_each_request() {
        let error = BackendError::Memory {
            what: "work",
            needed: 2,
            available: 1,
        };
        let of_each = error_of_each(&Watchdog::default(), &error);
        assert!(of_each.is_out_of_memory(), "{of_each:?}");
        assert_eq!(of_each.to_string(), error.to_string());
    }

    /// Calls `work` while the request 0 is submitted. Returns how that ended.
    fn while_submitting(
        work: impl FnOnce(&Shared<u32, (u32, usize)>, &Watchdog, &Counted),
    ) -> Ended {
        let (how, begins, end) = counted();
        let (shared, watchdog) = (Shared::default(), Watchdog::default());
        let first = thread::scope(|scope| {
            let first = scope.spawn(|| shared.run(&watchdog, 0, &how, &|| None));
            begins.recv().expect("a submission");
            work(&shared, &watchdog, &how);
            end.send(()).expect("a receiver");
            first.join().expect("no panic")
        });
        assert!(locked(&shared.state).waiting.is_empty());
        first
    }

    #[test]
    fn a_request_whose_caller_panics_is_withdrawn() {
        let first = while_submitting(|shared, watchdog, how| {
            let panics = || -> Option<()> { unreachable!("as a control of a caller may") };
            let second = || shared.run(watchdog, 1, how, &panics);
            assert!(catch_unwind(AssertUnwindSafe(second)).is_err());
            assert!(locked(&shared.state).waiting.is_empty());
        });
        assert!(first.is_ok());
    }

    #[test]
    fn a_request_that_is_over_before_its_submission_is_withdrawn() {
        let first = while_submitting(|shared, watchdog, how| {
            let over = shared.run(watchdog, 1, how, &|| Some("over"));
            assert_eq!(over.expect("no error"), ControlFlow::Break("over"));
        });
        // It was submitted, so it ends with what was done.
        assert_eq!(first.expect("no error"), ControlFlow::Continue((0, 1)));
    }
}
