//! Backup and restore of a data directory: the embedded queue, and its payloads in a folder.

use std::path::Path;

use anyhow::{Context, bail};

use super::process::keep_files_private;
use crate::queue::{copy_sqlite, read_copy};
use crate::storage::{Copied, copy_store, keep_only};

/// What a backup holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Backup {
    /// Number of jobs, the pairs of sequences included.
    pub jobs: usize,
    /// The files of their payloads and results.
    pub files: Copied,
}

/// Copies the data directory `data_dir` to the new folder `to`. A server may run on it.
///
/// The payloads are copied first, then the queue as it is at one moment, then the payloads that came
/// between. A payload is written before its job is accepted, and a result before its job succeeds: so
/// everything that the copied queue promises is in the copy. A job that was accepted while the first
/// copy ran and is removed while the second one runs may lack its files; then its result is lost.
///
/// # Errors
/// If `to` exists and is not empty, `data_dir` has no queue of this program's version or no payloads,
/// or a file cannot be read or written.
pub fn backup(data_dir: &Path, to: &Path) -> anyhow::Result<Backup> {
    keep_files_private();
    let (blobs, copy) = (data_dir.join("blobs"), to.join("blobs"));
    if !blobs.join("identity").exists() {
        bail!(
            "{} has no payloads of a queue: of nodes with queue.postgres or storage, back up the \
             database and the bucket",
            data_dir.display()
        );
    }
    make_empty(to)?;
    let inside = |folder: &Path| {
        Some(
            to.canonicalize()
                .ok()?
                .starts_with(folder.canonicalize().ok()?),
        )
    };
    if inside(data_dir) == Some(true) {
        bail!(
            "{} lies in the data directory: name a folder outside of it",
            to.display()
        );
    }
    let copying = || format!("cannot copy {} to {}", blobs.display(), copy.display());
    let first = copy_store(&blobs, &copy).with_context(copying)?;
    let queue = copy_sqlite(data_dir, to)?;
    let second = copy_store(&blobs, &copy).with_context(copying)?;
    keep_only(&copy, &queue.jobs).with_context(copying)?;
    // Running jobs of the copy were not running when a process crashed.
    std::fs::File::create(to.join("queue.stopped")).with_context(copying)?;
    Ok(Backup {
        jobs: queue.jobs.len(),
        files: Copied {
            files: first.files + second.files,
            bytes: first.bytes + second.bytes,
        },
    })
}

/// Checks a backup and copies it to the new data directory `data_dir`.
///
/// # Errors
/// If `data_dir` exists and is not empty, the backup is damaged or of another version, its parts do
/// not belong together, or a file cannot be read or written.
pub fn restore(from: &Path, data_dir: &Path) -> anyhow::Result<Backup> {
    let queue = read_copy(from).context("the backup cannot be used")?;
    let identity = std::fs::read_to_string(from.join("blobs/identity"));
    let identity = identity.context("the backup has no payloads")?;
    if identity.trim() != queue.identity.to_string() {
        bail!("the queue and the payloads of the backup are not of one server");
    }
    keep_files_private();
    make_empty(data_dir)?;
    let copying = || format!("cannot copy {} to {}", from.display(), data_dir.display());
    let files = copy_store(&from.join("blobs"), &data_dir.join("blobs")).with_context(copying)?;
    for name in ["queue.sqlite3", "queue.stopped"] {
        std::fs::copy(from.join(name), data_dir.join(name)).with_context(copying)?;
    }
    Ok(Backup {
        jobs: queue.jobs.len(),
        files,
    })
}

/// Makes a folder, or refuses one that is not empty.
fn make_empty(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let mut entries = std::fs::read_dir(folder)?;
    match entries.next() {
        None => Ok(()),
        Some(_) => bail!("{} is not empty: name a new folder", folder.display()),
    }
}
