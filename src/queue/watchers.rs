//! Who follows which job: the latest of each, pushed to those who look.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::watch;

use super::Progress;
use crate::job::{Job, JobId, State};

/// The followed jobs. An entry lives as long as somebody follows it.
#[derive(Debug, Default)]
pub(super) struct Watchers {
    followed: Mutex<HashMap<JobId, watch::Sender<Arc<Job>>>>,
}

impl Watchers {
    fn lock(&self) -> MutexGuard<'_, HashMap<JobId, watch::Sender<Arc<Job>>>> {
        self.followed.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Follows `job`, which is what the store said a moment ago; what was pushed since is kept.
    pub(super) fn follow(&self, job: &Arc<Job>) -> watch::Receiver<Arc<Job>> {
        if job.state.is_end() {
            // Nothing more will come: its last state is all there is to see.
            return watch::Sender::new(Arc::clone(job)).subscribe();
        }
        let mut followed = self.lock();
        let sender = followed
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

    /// Pushes what is now stored.
    pub(super) fn push(&self, job: &Arc<Job>) {
        let mut followed = self.lock();
        if let Some(sender) = followed.get(&job.id) {
            sender.send_replace(Arc::clone(job));
            // Those who follow still see the last state when its sender is gone.
            if sender.receiver_count() == 0 || job.state.is_end() {
                followed.remove(&job.id);
            }
        }
    }

    /// Pushes an iteration of a running job.
    pub(super) fn progress(&self, id: JobId, attempt: u32, progress: Progress) {
        let followed = self.lock();
        if let Some(sender) = followed.get(&id) {
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

/// Whether `job` is further on its way than `known`.
fn is_newer(job: &Job, known: &Job) -> bool {
    let rank = |job: &Job| (job.attempt, job.state.is_end(), job.state == State::Running);
    rank(job) > rank(known)
}
