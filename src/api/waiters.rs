//! The number of callers that wait for each job that is not durable.
//!
//! A retry with the same idempotency key finds the job of a call whose connection was lost, so
//! several calls may wait for one job. The job is cancelled when the last of them disconnects. A
//! call that arrives during the cancellation waits for its end and submits a new job.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard};

use tokio_util::sync::CancellationToken;

use crate::job::JobId;
use crate::queue::Queue;
use crate::sync::locked;

/// The waiters of all jobs.
#[derive(Default)]
pub(super) struct Waiters {
    waiting: Mutex<HashMap<JobId, Waiting>>,
}

enum Waiting {
    /// The number of waiting calls.
    For(usize),
    /// The last waiter has disconnected and the job is being cancelled. The token is cancelled when
    /// that is done.
    Ending(CancellationToken),
}

/// One waiter of a job. When it is dropped as the last waiter, the job is cancelled.
pub(super) struct Awaited {
    waiters: Arc<Waiters>,
    queue: Arc<dyn Queue>,
    id: JobId,
    disarm: bool,
}

/// A cancellation in progress. Wait for its end before the job is submitted again.
pub(super) struct Ending(CancellationToken);

impl Ending {
    /// Waits until the cancellation is done.
    pub(super) async fn is_over(&self) {
        self.0.cancelled().await;
    }
}

impl Waiters {
    fn lock(&self) -> MutexGuard<'_, HashMap<JobId, Waiting>> {
        locked(&self.waiting)
    }

    /// Whether no call waits for a job.
    pub(super) fn are_none(&self) -> bool {
        let waiting = self.lock();
        !waiting.values().any(|one| matches!(one, Waiting::For(_)))
    }

    /// Registers one more waiter for a job of `queue`.
    ///
    /// # Errors
    /// [`Ending`] if the job is being cancelled.
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
            disarm: false,
        })
    }

    /// Removes a waiter without cancelling the job.
    fn leave(&self, id: JobId) {
        let mut waiting = self.lock();
        if let Some(Waiting::For(count)) = waiting.get_mut(&id) {
            *count -= 1;
            if *count == 0 {
                waiting.remove(&id);
            }
        }
    }

    /// Removes a waiter, and cancels the job if it was the last one.
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
    /// Removes the waiter without cancelling the job: the job has ended, or it is durable now.
    pub(super) fn disarm(mut self) {
        self.disarm = true;
    }
}

impl Drop for Awaited {
    fn drop(&mut self) {
        if self.disarm {
            self.waiters.leave(self.id);
        } else {
            self.waiters.abandon(&self.queue, self.id);
        }
    }
}
