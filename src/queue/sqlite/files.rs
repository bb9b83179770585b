//! Files of the queue besides the database: detection of replaced files, and the marker of a
//! graceful shutdown.

use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Paths of the queue's files, each with its device and inode numbers at opening.
pub(super) struct Files([(PathBuf, (u64, u64)); 2]);

impl Files {
    pub(super) fn of(paths: [PathBuf; 2]) -> std::io::Result<Self> {
        let [one, other] = paths;
        let which = |path: &Path| std::fs::metadata(path).map(|about| (about.dev(), about.ino()));
        let (first, second) = (which(&one)?, which(&other)?);
        Ok(Self([(one, first), (other, second)]))
    }

    /// Whether the paths still refer to the same files. Writes to a removed or replaced file are
    /// lost.
    pub(super) fn are_there(&self) -> bool {
        self.0.iter().all(|(path, was)| {
            std::fs::metadata(path).is_ok_and(|about| (about.dev(), about.ino()) == *was)
        })
    }
}

/// Names of a marker file that records whether the last process shut down gracefully. The file is
/// normally created once, when there is space, and only renamed later.
pub(super) const RUNNING: &str = "queue.running";
pub(super) const STOPPED: &str = "queue.stopped";

/// Renames the marker file and returns whether it had the name `from`. If it did not, creates it as
/// `to`.
pub(super) fn run_mark(folder: &Path, from: &str, to: &str) -> bool {
    let renamed = std::fs::rename(folder.join(from), folder.join(to)).is_ok();
    if !renamed && let Err(error) = File::create(folder.join(to)) {
        tracing::debug!(%error, "a mark was not made");
    }
    renamed
}
