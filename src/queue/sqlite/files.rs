//! The queue's files besides the database: whether they are still those that it has open, and how the
//! last process ended.

use std::fs::File;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// The queue's files by name, and which they were when it was opened.
pub(super) struct Files([(PathBuf, (u64, u64)); 2]);

impl Files {
    pub(super) fn of(paths: [PathBuf; 2]) -> std::io::Result<Self> {
        let [one, other] = paths;
        let which = |path: &Path| std::fs::metadata(path).map(|about| (about.dev(), about.ino()));
        let (first, second) = (which(&one)?, which(&other)?);
        Ok(Self([(one, first), (other, second)]))
    }

    /// Whether the names are still those of the same files: what is written to others is lost.
    pub(super) fn are_there(&self) -> bool {
        self.0.iter().all(|(path, was)| {
            std::fs::metadata(path).is_ok_and(|about| (about.dev(), about.ino()) == *was)
        })
    }
}

/// The file that says by its name whether the last process that had the queue ended in order. It is
/// made when there is room and only renamed later.
pub(super) const RUNNING: &str = "queue.running";
pub(super) const STOPPED: &str = "queue.stopped";

/// Renames that file; says whether it had that name. Where it has none it gets the new one.
pub(super) fn run_mark(folder: &Path, from: &str, to: &str) -> bool {
    let renamed = std::fs::rename(folder.join(from), folder.join(to)).is_ok();
    if !renamed && let Err(error) = File::create(folder.join(to)) {
        tracing::debug!(%error, "a mark was not made");
    }
    renamed
}
