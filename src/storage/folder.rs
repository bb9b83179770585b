//! The part of the store that only a folder has: free space, modes, and the remains of interrupted
//! writes. All functions block.

use std::fs::{self, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::blob::{FreeSpace, folder};
use crate::job::JobId;

/// The names of the files of probes begin with this.
const PROBE: &str = "probe-";

/// Creates the folder and gives it the mode 0700.
pub(super) fn prepare(root: &Path) -> io::Result<()> {
    fs::create_dir_all(root)?;
    // An existing folder may have other permissions.
    fs::set_permissions(root, Permissions::from_mode(0o700))
}

/// Free space of its file system; `None` if the system does not report it.
pub(super) fn free_space(root: &Path) -> Option<FreeSpace> {
    let filesystem = rustix::fs::statvfs(root).ok()?;
    Some(FreeSpace {
        bytes: filesystem.f_bavail.saturating_mul(filesystem.f_frsize),
        inodes: (filesystem.f_files > 0).then_some(filesystem.f_favail),
    })
}

/// Writes a file at the root of the store, replacing an earlier one, and waits for the disk.
pub(super) fn write(root: &Path, name: &str, text: &str) -> io::Result<()> {
    // A crash leaves the earlier file or the new one, never an empty one.
    let written = root.join(format!("{name}.new"));
    let mut file = fs::File::create(&written)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()?;
    fs::rename(&written, root.join(name))?;
    fs::File::open(root)?.sync_all()
}

/// Writes, syncs, reads back and removes a file, and checks that twice `needed` bytes are free, and
/// at least 4 MiB.
pub(super) fn probe(root: &Path, needed: u64) -> io::Result<()> {
    const BYTES: usize = 64 << 10;
    const ROOM: u64 = 4 << 20;
    // Several nodes may test the folder at once.
    let path = root.join(format!("jobs/{PROBE}{}", JobId::fresh()));
    fs::create_dir_all(root.join("jobs"))?;
    let bytes = vec![7; BYTES];
    let mut file = fs::File::create(&path)?;
    file.write_all(&bytes)?;
    file.sync_data()?;
    let read = fs::read(&path)?;
    fs::remove_file(&path)?;
    if read != bytes {
        return Err(io::ErrorKind::InvalidData.into());
    }
    let least = ROOM.max(needed.saturating_mul(2));
    match free_space(root) {
        Some(free) if free.bytes < least => Err(io::ErrorKind::StorageFull.into()),
        _ => Ok(()),
    }
}

/// Removes all blobs of a job, including the remains of interrupted writes.
pub(super) fn remove_job(root: &Path, id: JobId) -> io::Result<()> {
    let folder = root.join(folder(id));
    match fs::remove_dir_all(&folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    // This fails while the folder holds other jobs, as intended.
    let _not_empty = folder.parent().map(fs::remove_dir);
    Ok(())
}

/// Whether there are no blobs of any job.
pub(super) fn is_empty(root: &Path) -> io::Result<bool> {
    // An interrupted probe leaves a file; jobs are folders.
    Ok(!entries(&root.join("jobs"))?
        .iter()
        .any(|path| path.is_dir()))
}

/// The jobs whose folder and files were all last changed more than `age` ago.
pub(super) fn jobs_older_than(root: &Path, age: Duration) -> io::Result<Vec<JobId>> {
    let limit = SystemTime::now().checked_sub(age);
    let is_old = |path: &Path| is_older(path, limit);
    let mut found = Vec::new();
    for minute in entries(&root.join("jobs"))? {
        for job in entries(&minute)? {
            let name = job.file_name().unwrap_or_default().to_string_lossy();
            let Ok(id) = name.parse() else { continue };
            let mut all_old = is_old(&job)?;
            for blob in entries(&job)? {
                all_old &= is_old(&blob)?;
            }
            if all_old {
                found.push(id);
            }
        }
    }
    Ok(found)
}

/// Removes the remains of interrupted writes and probes that were last changed more than `age` ago,
/// and counts them.
pub(super) fn remove_cut_off(root: &Path, age: Duration) -> io::Result<usize> {
    let limit = SystemTime::now().checked_sub(age);
    let mut removed = 0;
    for minute in entries(&root.join("jobs"))? {
        let name = minute.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with(PROBE) && is_older(&minute, limit)? {
            fs::remove_file(&minute)?;
            removed += 1;
        }
        for job in entries(&minute)? {
            for blob in entries(&job)? {
                if is_staged(&blob) && is_older(&blob, limit)? {
                    fs::remove_file(&blob)?;
                    removed += 1;
                }
            }
        }
    }
    Ok(removed)
}

/// Removes the remains of interrupted writes in a folder and in all folders below it that were last
/// changed more than `age` ago, and counts them.
pub(super) fn remove_staged_below(root: &Path, age: Duration) -> io::Result<usize> {
    let limit = SystemTime::now().checked_sub(age);
    let mut removed = 0;
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in entries(&folder)? {
            if path.is_dir() {
                folders.push(path);
            } else if is_staged(&path) && is_older(&path, limit)? {
                fs::remove_file(&path)?;
                removed += 1;
            }
        }
    }
    Ok(removed)
}

/// Whether a file is a staged write, such as `sweep-0#1`, which is renamed when it is complete.
fn is_staged(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.rsplit_once('#')
        .is_some_and(|(_, number)| number.bytes().all(|byte| byte.is_ascii_digit()))
}

/// Whether a file was last changed before `limit`. A file that is gone meanwhile counts as older.
fn is_older(path: &Path, limit: Option<SystemTime>) -> io::Result<bool> {
    match fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(true),
        about => {
            let changed = about?.modified()?;
            Ok(limit.is_some_and(|limit| changed < limit))
        }
    }
}

/// The entries of a folder; empty if the folder does not exist or is not a folder.
fn entries(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let listed = match fs::read_dir(folder) {
        Err(error)
            if matches!(
                error.kind(),
                io::ErrorKind::NotFound | io::ErrorKind::NotADirectory
            ) =>
        {
            return Ok(Vec::new());
        }
        listed => listed?,
    };
    listed.map(|entry| Ok(entry?.path())).collect()
}
