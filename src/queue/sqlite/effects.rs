//! Effects of a transaction outside the database, applied after its commit.

use std::sync::Arc;

use crate::job::{Job, JobId};
use crate::queue::types::Event;

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
    /// Running jobs whose cancellation was requested.
    pub(super) cancel: Vec<JobId>,
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
}
