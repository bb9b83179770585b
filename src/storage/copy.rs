//! Copies of a store in a folder, while another process may write to it.
//!
//! A file of a store is never changed: it is written under another name and renamed. So a file that
//! was copied once is complete.

use std::collections::HashSet;
use std::fs;
use std::io;
use std::path::Path;

use super::folder::prepare;
use crate::job::JobId;

/// The file with the identity of a store.
const IDENTITY: &str = "identity";

/// What was copied.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Copied {
    /// Number of files.
    pub files: u64,
    /// Their size, bytes.
    pub bytes: u64,
}

/// Copies the files of the store in the folder `from` that the one in `to` does not have. Files that
/// are removed meanwhile are left out.
///
/// # Errors
/// That of the operating system.
pub fn copy_store(from: &Path, to: &Path) -> io::Result<Copied> {
    prepare(to)?;
    let mut copied = Copied::default();
    copy_file(&from.join(IDENTITY), &to.join(IDENTITY), &mut copied)?;
    copy_folder(&from.join("jobs"), &to.join("jobs"), &mut copied)?;
    Ok(copied)
}

fn copy_folder(from: &Path, to: &Path, copied: &mut Copied) -> io::Result<()> {
    if fs::symlink_metadata(from).is_ok_and(|about| about.is_symlink()) {
        let text = format!("{} is a link, and a store has none", from.display());
        return Err(io::Error::other(text));
    }
    let entries = match fs::read_dir(from) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        entries => entries?,
    };
    fs::create_dir_all(to)?;
    for entry in entries {
        let entry = entry?;
        let (path, goal) = (entry.path(), to.join(entry.file_name()));
        // Files that are being written have other names than blobs.
        let name = entry.file_name();
        let is_unfinished = name.to_string_lossy().contains(['#', '.']);
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => copy_folder(&path, &goal, copied)?,
            Ok(kind) if kind.is_file() && !is_unfinished => copy_file(&path, &goal, copied)?,
            _ => {}
        }
    }
    Ok(())
}

fn copy_file(from: &Path, to: &Path, copied: &mut Copied) -> io::Result<()> {
    if to.exists() {
        return Ok(());
    }
    match fs::copy(from, to) {
        Ok(bytes) => {
            fs::File::open(to)?.sync_all()?;
            copied.files += 1;
            copied.bytes += bytes;
            Ok(())
        }
        // Its job was removed meanwhile.
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            let _nothing_was_written = fs::remove_file(to);
            Ok(())
        }
        Err(error) => Err(error),
    }
}

/// Removes the files of all other jobs than these from a copy of a store.
///
/// # Errors
/// That of the operating system.
pub fn keep_only(root: &Path, jobs: &[JobId]) -> io::Result<()> {
    let known: HashSet<JobId> = jobs.iter().copied().collect();
    for group in fs::read_dir(root.join("jobs")).into_iter().flatten() {
        for job in fs::read_dir(group?.path()).into_iter().flatten() {
            let job = job?;
            let id = job.file_name().to_string_lossy().parse::<JobId>();
            if !id.is_ok_and(|id| known.contains(&id)) {
                fs::remove_dir_all(job.path())?;
            }
        }
    }
    Ok(())
}
