//! Whether the queue's files are still those that it has open.

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
