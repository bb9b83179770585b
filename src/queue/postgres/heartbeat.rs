//! The heartbeat of a lease.

use std::sync::Arc;

use super::beats::Beat;
use super::shared::Shared;
use crate::job::{JobId, JobProgress};
use crate::queue::lease::HeartbeatStore;

/// The heartbeat of one lease. Every progress goes to the subscribers of this process at once.
pub(super) struct PostgresHeartbeat {
    pub(super) id: JobId,
    pub(super) attempt: u32,
    pub(super) shared: Arc<Shared>,
}

impl HeartbeatStore for PostgresHeartbeat {
    fn beat(&self, progress: Option<JobProgress>) {
        if let Some(progress) = progress {
            let watchers = &self.shared.local.watchers;
            watchers.progress(self.id, self.attempt, progress);
        }
        let beat = Beat {
            progress,
            snapshot_kept: false,
        };
        self.shared.beats.add(self.id, self.attempt, beat);
    }

    fn snapshot_kept(&self) {
        let beat = Beat {
            progress: None,
            snapshot_kept: true,
        };
        self.shared.beats.add(self.id, self.attempt, beat);
        // If this process ends now, the crash is not to be counted with those before the snapshot.
        self.shared.bell.beat_now();
    }
}
