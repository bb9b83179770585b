//! Effects of a transaction outside the database, applied after its commit.

use std::sync::Arc;

use super::backlog::Backlog;
use super::types::Event;
use crate::job::{Job, JobId};

/// Updates of the backlog, running jobs, subscriptions and events that follow a commit.
#[derive(Debug, Default)]
pub(super) struct Effects {
    /// Jobs that entered the queue.
    pub(super) entered: Vec<Arc<Job>>,
    /// Jobs that left the queue, leased or ended.
    pub(super) left: Vec<Arc<Job>>,
    /// Jobs that were leased to a worker.
    pub(super) started: Vec<Arc<Job>>,
    /// Jobs that a worker held and now does not.
    pub(super) stopped: Vec<Arc<Job>>,
    /// Running jobs whose cancellation was requested, and their attempts.
    pub(super) cancel: Vec<(JobId, u32)>,
    /// All jobs with a changed row.
    pub(super) changed: Vec<Arc<Job>>,
    /// Events for the metrics and the cleanup of blobs.
    pub(super) events: Vec<Event>,
}

impl Effects {
    pub(super) fn merge(&mut self, other: Self) {
        self.entered.extend(other.entered);
        self.left.extend(other.left);
        self.started.extend(other.started);
        self.stopped.extend(other.stopped);
        self.cancel.extend(other.cancel);
        self.changed.extend(other.changed);
        self.events.extend(other.events);
    }

    /// Changes the load as the commit did.
    pub(super) fn change(&self, backlog: &mut Backlog) {
        // A job may enter and leave in one commit, so entries are counted first.
        self.entered.iter().for_each(|job| backlog.entered(job));
        self.left.iter().for_each(|job| backlog.left(job));
        self.stopped.iter().for_each(|job| backlog.stopped(job));
        self.started.iter().for_each(|job| backlog.started(job));
    }

    /// The part that changes the load.
    pub(super) fn of_load(&self) -> Self {
        Self {
            entered: self.entered.clone(),
            left: self.left.clone(),
            started: self.started.clone(),
            stopped: self.stopped.clone(),
            ..Self::default()
        }
    }
}
