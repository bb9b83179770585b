//! The heartbeats of the leases that this process holds, collected until the upkeep writes them.

use std::collections::HashMap;
use std::sync::Mutex;

use crate::job::{JobId, JobProgress};
use crate::sync::locked;

/// What is to be written for one lease.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Beat {
    pub(super) progress: Option<JobProgress>,
    pub(super) snapshot_kept: bool,
}

/// The heartbeats since the last write, by job and attempt.
#[derive(Debug, Default)]
pub(super) struct Beats(Mutex<Collected>);

#[derive(Debug, Default)]
struct Collected {
    waiting: HashMap<(JobId, u32), Beat>,
    /// Those that are being written: what they say is not in the database yet.
    leaving: HashMap<(JobId, u32), Beat>,
}

impl Beats {
    /// Whether a snapshot of this attempt was stored and that is not written yet.
    pub(super) fn has_note_of_snapshot(&self, id: JobId, attempt: u32) -> bool {
        let beats = locked(&self.0);
        [&beats.waiting, &beats.leaving]
            .iter()
            .filter_map(|of| of.get(&(id, attempt)))
            .any(|beat| beat.snapshot_kept)
    }

    /// Adds a heartbeat.
    pub(super) fn add(&self, id: JobId, attempt: u32, beat: Beat) {
        let mut beats = locked(&self.0);
        let known = beats.waiting.entry((id, attempt)).or_default();
        known.progress = beat.progress.or(known.progress);
        known.snapshot_kept |= beat.snapshot_kept;
    }

    /// All of them, to be written. [`Beats::written`] ends the write.
    pub(super) fn take(&self) -> HashMap<(JobId, u32), Beat> {
        let mut beats = locked(&self.0);
        beats.leaving = std::mem::take(&mut beats.waiting);
        beats.leaving.clone()
    }

    /// Those that were taken are in the database.
    pub(super) fn written(&self) {
        locked(&self.0).leaving.clear();
    }
}
