//! Heartbeats of a lease, forwarded to the writer thread.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::writer::Writer;
use crate::job::{Job, JobId, JobProgress};
use crate::queue::lease::HeartbeatStore;
use crate::queue::local::Local;
use crate::queue::time;
use crate::queue::transitions::leases;
use crate::queue::types::QueueOptions;
use crate::sync::locked;

/// Minimum interval between two lease renewals on disk.
const BEAT: Duration = Duration::from_secs(1);

/// The heartbeat of one lease. Every progress update goes to the subscribers; a renewal goes to
/// disk once a second, or every quarter of the lease if that is shorter.
pub(super) struct SqliteHeartbeat {
    id: JobId,
    attempt: u32,
    writer: Writer,
    local: Arc<Local>,
    options: QueueOptions,
    last: Mutex<Instant>,
    latest: Mutex<Option<JobProgress>>,
}

impl SqliteHeartbeat {
    /// The heartbeat of a job that was just claimed.
    pub(super) fn new(
        job: &Job,
        writer: &Writer,
        local: &Arc<Local>,
        options: &QueueOptions,
    ) -> Self {
        Self {
            id: job.id,
            attempt: job.attempt,
            writer: writer.clone(),
            local: Arc::clone(local),
            options: options.clone(),
            last: Mutex::new(time::monotonic()),
            latest: Mutex::default(),
        }
    }
}

impl HeartbeatStore for SqliteHeartbeat {
    fn beat(&self, progress: Option<JobProgress>) {
        if let Some(progress) = progress {
            *locked(&self.latest) = Some(progress);
            self.local
                .watchers
                .progress(self.id, self.attempt, progress);
        }
        {
            let mut last = locked(&self.last);
            if time::monotonic() - *last < BEAT.min(self.options.lease / 4) {
                return;
            }
            *last = time::monotonic();
        }
        let (id, attempt, options) = (self.id, self.attempt, self.options.clone());
        let progress = *locked(&self.latest);
        self.writer
            .write_later(move |sql, _| leases::beat(sql, &options, id, attempt, progress));
    }

    fn snapshot_kept(&self) {
        let (id, attempt) = (self.id, self.attempt);
        self.writer
            .write_later(move |sql, _| leases::snapshot_kept(sql, id, attempt));
    }
}
