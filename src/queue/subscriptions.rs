//! Subscriptions: publishes the latest state of each watched job to its subscribers.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard};

use tokio::sync::watch;

use crate::job::{Job, JobId, JobProgress, State};
use crate::sync::locked;

/// The watched jobs. An entry is removed when its job ends, or at a state update without
/// subscribers.
#[derive(Debug, Default)]
pub(super) struct Watchers {
    senders: Mutex<HashMap<JobId, watch::Sender<Arc<Job>>>>,
}

impl Watchers {
    fn lock(&self) -> MutexGuard<'_, HashMap<JobId, watch::Sender<Arc<Job>>>> {
        locked(&self.senders)
    }

    /// Subscribes to `job`, as just read from the database. A newer published state is kept.
    pub(super) fn follow(&self, job: &Arc<Job>) -> watch::Receiver<Arc<Job>> {
        if job.state.is_end() {
            // An ended job does not change: its last state is enough.
            return watch::Sender::new(Arc::clone(job)).subscribe();
        }
        let mut senders = self.lock();
        let sender = senders
            .entry(job.id)
            .or_insert_with(|| watch::Sender::new(Arc::clone(job)));
        sender.send_if_modified(|known| {
            let newer = is_newer(job, known);
            if newer {
                *known = Arc::clone(job);
            }
            newer
        });
        sender.subscribe()
    }

    /// Publishes the stored state of a job.
    pub(super) fn push(&self, job: &Arc<Job>) {
        let mut senders = self.lock();
        if let Some(sender) = senders.get(&job.id) {
            sender.send_replace(Arc::clone(job));
            // Subscribers can still read the last state after the sender is dropped.
            if sender.receiver_count() == 0 || job.state.is_end() {
                senders.remove(&job.id);
            }
        }
    }

    /// The watched jobs. Those without subscribers are dropped.
    pub(super) fn jobs(&self) -> Vec<JobId> {
        let mut senders = self.lock();
        senders.retain(|_, sender| sender.receiver_count() > 0);
        senders.keys().copied().collect()
    }

    /// Publishes the stored state of a job if it has changed. With `keep_progress` the progress
    /// that was published last is newer than the stored one.
    pub(super) fn refresh(&self, job: &Arc<Job>, keep_progress: bool) {
        let is_changed = self.lock().get(&job.id).is_some_and(|sender| {
            let known = sender.borrow();
            let mut job = Job::clone(job);
            if keep_progress {
                job.progress = known.progress;
            }
            **known != job
        });
        if is_changed || job.state.is_end() {
            self.push(job);
        }
    }

    /// Ends the subscriptions to a job that was removed.
    pub(super) fn forget(&self, id: JobId) {
        self.lock().remove(&id);
    }

    /// Publishes the progress of a running job.
    pub(super) fn progress(&self, id: JobId, attempt: u32, progress: JobProgress) {
        let senders = self.lock();
        if let Some(sender) = senders.get(&id) {
            sender.send_if_modified(|job| {
                let current = job.state == State::Running && job.attempt == attempt;
                if current {
                    Arc::make_mut(job).progress = Some(progress);
                }
                current
            });
        }
    }
}

/// Whether `job` is a later state than `known`.
fn is_newer(job: &Job, known: &Job) -> bool {
    let rank = |job: &Job| (job.attempt, job.state.is_end(), job.state == State::Running);
    rank(job) > rank(known)
}
