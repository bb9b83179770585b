//! Long work under the eyes of the interpreter: it can be interrupted, and reports its progress.

use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::{Duration, Instant};

use fnsf::flow::{Control, Interrupt, Progress};
use pyo3::prelude::*;

use crate::device::cpu;
use crate::errors::{DeviceError, input, internal};

/// How often signals are looked for and progress is passed on.
const LOOK: Duration = Duration::from_millis(50);
/// Stack of the thread that works, bytes.
const STACK: usize = 8 << 20;

/// The control of one call.
pub(crate) struct Watch {
    began: Instant,
    deadline: Option<Duration>,
    cancelled: AtomicBool,
    progress: Mutex<Option<Progress>>,
}

impl Watch {
    /// `deadline` is in seconds from now.
    pub(crate) fn new(deadline: Option<f64>) -> PyResult<Self> {
        let deadline = deadline.map(|seconds| {
            let refused = || input(format!("deadline is {seconds} s: more than 0 is needed"));
            match Duration::try_from_secs_f64(seconds) {
                Ok(duration) if !duration.is_zero() => Ok(duration),
                _ => Err(refused()),
            }
        });
        Ok(Self {
            began: Instant::now(),
            deadline: deadline.transpose()?,
            cancelled: AtomicBool::new(false),
            progress: Mutex::new(None),
        })
    }

    fn take_progress(&self) -> Option<Progress> {
        let mut latest = self.progress.lock().unwrap_or_else(PoisonError::into_inner);
        latest.take()
    }
}

impl Control for Watch {
    fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    fn seconds_left(&self) -> Option<f64> {
        let deadline = self.deadline?.as_secs_f64();
        Some(deadline - self.seconds())
    }

    fn interrupt(&self) -> Option<Interrupt> {
        if self.cancelled.load(Ordering::Relaxed) {
            return Some(Interrupt::Cancelled);
        }
        let late = self.seconds_left().is_some_and(|left| left <= 0.0);
        late.then_some(Interrupt::Deadline)
    }

    fn progress(&self, progress: Progress) {
        *self.progress.lock().unwrap_or_else(PoisonError::into_inner) = Some(progress);
    }
}

/// As [`supervised`], on the threads of the CPU: for functions that compute in parallel and take no
/// backend. rayon's global threads are never used, because a forked child has none of them.
pub(crate) fn supervised_on_threads<T: Send>(
    py: Python<'_>,
    watch: &Watch,
    work: impl FnOnce() -> T + Send,
) -> PyResult<T> {
    let backend = cpu(None)?;
    supervised(py, watch, None, || backend.host().install(work))
}

/// Does `work` on a thread of its own without the interpreter's lock. The calling thread passes
/// progress on to `told(done, total, loss)` and looks for signals: Ctrl-C cancels the work.
///
/// # Errors
/// The exception of a signal's handler or of `told`, and `Error` where the work panicked.
pub(crate) fn supervised<T: Send>(
    py: Python<'_>,
    watch: &Watch,
    told: Option<&Bound<'_, PyAny>>,
    work: impl FnOnce() -> T + Send,
) -> PyResult<T> {
    let told = told.map(|told| told.clone().unbind());
    let look = || {
        Python::attach(|py| {
            if let (Some(told), Some(progress)) = (&told, watch.take_progress()) {
                told.call1(py, (progress.done, progress.total, progress.loss))?;
            }
            py.check_signals()
        })
    };
    py.detach(|| {
        thread::scope(|scope| {
            let (done, result) = channel();
            let worker = thread::Builder::new()
                .name("fnsf".to_owned())
                .stack_size(STACK)
                .spawn_scoped(scope, move || {
                    // The receiver waits until the work has ended.
                    let _ = done.send(work());
                })
                .map_err(|error| DeviceError::new_err(error.to_string()))?;
            let mut stopped = None;
            loop {
                match result.recv_timeout(LOOK) {
                    Ok(result) => {
                        if stopped.is_none() {
                            stopped = look().err();
                        }
                        return stopped.map_or(Ok(result), Err);
                    }
                    Err(RecvTimeoutError::Timeout) if stopped.is_none() => {
                        if let Err(error) = look() {
                            watch.cancelled.store(true, Ordering::Relaxed);
                            stopped = Some(error);
                        }
                    }
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => {
                        let _ = worker.join();
                        return Err(internal(
                            "internal error: the computation panicked; please report it",
                        ));
                    }
                }
            }
        })
    })
}
