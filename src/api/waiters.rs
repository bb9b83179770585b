//! Who waits for which job: the last one to go away ends it.
//!
//! An idempotency key finds the job of a call whose connection was lost, so several calls may wait
//! for one job. The job is cancelled when the last of them disconnects. A call that arrives during the
//! cancellation waits for its end and submits a new job.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio_util::sync::CancellationToken;

use crate::job::JobId;
use crate::queue::Queue;

/// Who waits for which job.
#[derive(Default)]
pub(super) struct Waiters {
    waiting: Mutex<HashMap<JobId, Waiting>>,
}

enum Waiting {
    /// So many wait.
    For(usize),
    /// Nobody does: it is being ended, and this is cancelled when that is over.
    Ending(CancellationToken),
}

/// A job that somebody waits for on the line. Dropped, it is given up, unless others wait too.
pub(super) struct Awaited {
    waiters: Arc<Waiters>,
    queue: Arc<dyn Queue>,
    id: JobId,
    let_go: bool,
}

/// The job is being ended; to be waited for before it is asked for again.
pub(super) struct Ending(CancellationToken);

impl Ending {
    pub(super) async fn is_over(&self) {
        self.0.cancelled().await;
    }
}

impl Waiters {
    fn lock(&self) -> MutexGuard<'_, HashMap<JobId, Waiting>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// One more waits for a job, which `queue` has.
    pub(super) fn wait(
        self: &Arc<Self>,
        queue: &Arc<dyn Queue>,
        id: JobId,
    ) -> Result<Awaited, Ending> {
        match self.lock().entry(id).or_insert(Waiting::For(0)) {
            Waiting::For(count) => *count += 1,
            Waiting::Ending(over) => return Err(Ending(over.clone())),
        }
        Ok(Awaited {
            waiters: Arc::clone(self),
            queue: Arc::clone(queue),
            id,
            let_go: false,
        })
    }

    /// One less waits, and the job goes on.
    fn leave(&self, id: JobId) {
        let mut waiting = self.lock();
        if let Some(Waiting::For(count)) = waiting.get_mut(&id) {
            *count -= 1;
            if *count == 0 {
                waiting.remove(&id);
            }
        }
    }

    /// One less waits, and the job is ended if that was the last.
    fn abandon(self: &Arc<Self>, queue: &Arc<dyn Queue>, id: JobId) {
        let over = {
            let mut waiting = self.lock();
            match waiting.get_mut(&id) {
                Some(Waiting::For(count)) if *count > 1 => {
                    *count -= 1;
                    return;
                }
                Some(one) => {
                    let over = CancellationToken::new();
                    *one = Waiting::Ending(over.clone());
                    over
                }
                None => return,
            }
        };
        let (waiters, queue) = (Arc::clone(self), Arc::clone(queue));
        tokio::spawn(async move {
            let _even_by_a_panic = over.drop_guard();
            if let Err(error) = queue.abandon(id).await {
                tracing::warn!(%error, job = %id, "an abandoned job was not cancelled");
            }
            waiters.lock().remove(&id);
        });
    }
}

impl Awaited {
    /// The job has ended, or goes on by itself.
    pub(super) fn let_go(mut self) {
        self.let_go = true;
    }
}

impl Drop for Awaited {
    fn drop(&mut self) {
        if self.let_go {
            self.waiters.leave(self.id);
        } else {
            self.waiters.abandon(&self.queue, self.id);
        }
    }
}
