//! A worker's signs of life on their way to the writer.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::writer::Writer;
use super::{Shared, leases, locked};
use crate::job::JobId;
use crate::queue::lease::Heart;
use crate::queue::{Progress, QueueOptions};

/// A lease is prolonged on disk this often at most.
const BEAT: Duration = Duration::from_secs(1);

/// A lease's way to the writer: every beat to those who follow, one a second to the disk.
pub(super) struct SqliteHeart {
    pub(super) id: JobId,
    pub(super) attempt: u32,
    pub(super) writer: Writer,
    pub(super) shared: Arc<Shared>,
    pub(super) options: QueueOptions,
    pub(super) last: Mutex<Instant>,
    pub(super) latest: Mutex<Option<Progress>>,
}

impl Heart for SqliteHeart {
    fn beat(&self, progress: Option<Progress>) {
        if let Some(progress) = progress {
            *locked(&self.latest) = Some(progress);
            self.shared
                .watchers
                .progress(self.id, self.attempt, progress);
        }
        {
            let mut last = locked(&self.last);
            if last.elapsed() < BEAT.min(self.options.lease / 4) {
                return;
            }
            *last = Instant::now();
        }
        let (id, attempt, options) = (self.id, self.attempt, self.options.clone());
        let progress = *locked(&self.latest);
        self.writer.write_later(move |connection, _| {
            leases::beat(connection, &options, id, attempt, progress)
        });
    }

    fn snapshot_kept(&self) {
        let (id, attempt) = (self.id, self.attempt);
        self.writer
            .write_later(move |connection, _| leases::snapshot_kept(connection, id, attempt));
    }
}
