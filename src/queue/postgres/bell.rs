//! What has changed since it was last looked at, and the wake-up that goes with it.

use std::collections::HashSet;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use crate::job::{Job, JobId, State};
use crate::queue::effects::Effects;
use crate::queue::types::Event;
use crate::sync::locked;

/// Jobs whose rows have changed.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Changes {
    pub(super) jobs: HashSet<JobId>,
    /// Whether there are more than `jobs` names.
    pub(super) more: bool,
    /// Whether a job may have become ready to be leased.
    pub(super) ready: bool,
    /// Whether the other nodes are to be told at once: of a cancellation, or of a job whose caller
    /// waits.
    pub(super) urgent: bool,
}

impl Changes {
    /// The changes of a commit.
    pub(super) fn of(effects: &Effects) -> Self {
        let mut jobs: HashSet<_> = effects.changed.iter().map(|job| job.id).collect();
        jobs.extend(effects.cancel.iter().map(|(id, _)| *id));
        jobs.extend(effects.stopped.iter().map(|job| job.id));
        jobs.extend(effects.events.iter().filter_map(|event| match event {
            Event::Deleted(id) => Some(*id),
            _ => None,
        }));
        let is_ready = |job: &Arc<Job>| job.state == State::Queued && job.ready.is_some();
        let jobs_changed = || effects.entered.iter().chain(&effects.changed);
        let ready = jobs_changed().any(is_ready);
        Self {
            jobs,
            more: false,
            ready,
            urgent: !effects.cancel.is_empty() || !jobs_changed().all(|job| job.durable),
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    pub(super) fn merge(&mut self, other: Self) {
        self.jobs.extend(other.jobs);
        self.more |= other.more;
        self.ready |= other.ready;
        self.urgent |= other.urgent;
    }

    /// Whether the row of this job may have changed.
    pub(super) fn contains(&self, id: JobId) -> bool {
        self.more || self.jobs.contains(&id)
    }

    /// As the payload of a notification, which must be shorter than 8,000 bytes.
    pub(super) fn to_payload(&self) -> String {
        const MOST: usize = 200;
        let ready = if self.ready { "ready" } else { "" };
        if self.more || self.jobs.len() > MOST {
            return format!("{ready} *");
        }
        let mut payload = ready.to_owned();
        for id in &self.jobs {
            payload.push(' ');
            payload.push_str(&id.to_string());
        }
        payload
    }

    /// From the payload of a notification. What cannot be read stands for any job.
    pub(super) fn from_payload(payload: &str) -> Self {
        let mut changes = Self::default();
        for word in payload.split_whitespace() {
            match word.parse() {
                _ if word == "ready" => changes.ready = true,
                Ok(id) => {
                    changes.jobs.insert(id);
                }
                Err(_) => changes.more = true,
            }
        }
        changes
    }
}

/// Changes that the upkeep has not looked at.
#[derive(Debug, Default)]
pub(super) struct Rung {
    /// Made by this process; the other nodes are to be told.
    pub(super) here: Changes,
    /// Made by other nodes, or to be read for another reason.
    pub(super) elsewhere: Changes,
    /// Whether heartbeats are to be written at once.
    pub(super) beat_now: bool,
}

/// Collects changes and wakes the upkeep.
#[derive(Debug, Default)]
pub(super) struct Bell {
    rung: Mutex<Rung>,
    wake: Condvar,
}

impl Bell {
    pub(super) fn here(&self, changes: Changes) {
        locked(&self.rung).here.merge(changes);
        self.wake.notify_all();
    }

    pub(super) fn elsewhere(&self, changes: Changes) {
        locked(&self.rung).elsewhere.merge(changes);
        self.wake.notify_all();
    }

    pub(super) fn beat_now(&self) {
        locked(&self.rung).beat_now = true;
        self.wake.notify_all();
    }

    /// Waits for changes, at most for this long, and takes them.
    pub(super) fn wait(&self, longest: Duration) -> Rung {
        let rung = locked(&self.rung);
        let quiet =
            |rung: &mut Rung| !rung.beat_now && rung.here.is_empty() && rung.elsewhere.is_empty();
        let waited = self.wake.wait_timeout_while(rung, longest, quiet);
        let (mut rung, _) = waited.unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut *rung)
    }

    /// Has the upkeep read all jobs that this process watches or holds.
    pub(super) fn wake(&self) {
        let more = Changes {
            more: true,
            ..Changes::default()
        };
        self.elsewhere(more);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_come_back_from_their_payload_which_is_never_too_long() {
        let mut changes = Changes {
            ready: true,
            ..Changes::default()
        };
        assert_eq!(Changes::from_payload(&changes.to_payload()), changes);
        changes.jobs = (0..200).map(|_| JobId::fresh()).collect();
        let payload = changes.to_payload();
        assert!(payload.len() < 8000, "{}", payload.len());
        assert_eq!(Changes::from_payload(&payload), changes);
        changes.jobs.insert(JobId::fresh());
        let back = Changes::from_payload(&changes.to_payload());
        assert!(back.more && back.ready && back.jobs.is_empty());
        let newer = Changes::from_payload("ready word-of-a-newer-program");
        assert!(newer.more && newer.ready);
    }
}
