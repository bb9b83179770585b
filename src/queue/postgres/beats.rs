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
pub(super) struct Beats(Mutex<HashMap<(JobId, u32), Beat>>);

impl Beats {
    /// Whether a snapshot of this attempt was stored and that is not written yet.
    pub(super) fn has_note_of_snapshot(&self, id: JobId, attempt: u32) -> bool {
        let beats = locked(&self.0);
        let beat = beats.get(&(id, attempt));
        beat.is_some_and(|beat| beat.snapshot_kept)
    }

    /// Adds a heartbeat.
    pub(super) fn add(&self, id: JobId, attempt: u32, beat: Beat) {
        let mut beats = locked(&self.0);
        let known = beats.entry((id, attempt)).or_default();
        known.progress = beat.progress.or(known.progress);
        known.snapshot_kept |= beat.snapshot_kept;
    }

    /// All of them.
    pub(super) fn take(&self) -> HashMap<(JobId, u32), Beat> {
        std::mem::take(&mut locked(&self.0))
    }
}
