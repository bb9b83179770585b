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
    let limit = own_time(&root.join("jobs")).checked_sub(age);
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
    let limit = own_time(&root.join("jobs")).checked_sub(age);
    let mut removed = 0;
    for minute in entries(&root.join("jobs"))? {
        let name = minute.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with(PROBE) && is_older(&minute, limit)? {
            fs::remove_file(&minute)?;
            removed += 1;
        }
        for job in entries(&minute)? {
            for blob in entries(&job)? {
                if staged_of(&blob).is_some() && is_older(&blob, limit)? {
                    fs::remove_file(&blob)?;
                    removed += 1;
                }
            }
        }
    }
    Ok(removed)
}

/// Removes the remains of interrupted writes of files with one of these endings, in a folder and in all
/// folders below it, that were last changed more than `age` ago, and counts them. Links are not followed.
pub(super) fn remove_staged_below(
    root: &Path,
    endings: &[&str],
    age: Duration,
) -> io::Result<usize> {
    let limit = own_time(root).checked_sub(age);
    let mut removed = 0;
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in entries(&folder)? {
            let kind = match fs::symlink_metadata(&path) {
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                about => about?.file_type(),
            };
            if kind.is_dir() {
                folders.push(path);
            } else if kind.is_file()
                && staged_of(&path)
                    .is_some_and(|name| endings.iter().any(|end| name.ends_with(end)))
                && is_older(&path, limit)?
            {
                fs::remove_file(&path)?;
                removed += 1;
            }
        }
    }
    Ok(removed)
}

/// The time by the clock of a folder's file system, which may be another machine's. Where nothing can be
/// written, the time of this machine.
fn own_time(folder: &Path) -> SystemTime {
    // Named as a staged write and as a probe, so that a crash leaves nothing for long.
    let path = folder.join(format!("{PROBE}{}.json#0", JobId::fresh()));
    let file = fs::create_dir_all(folder).and_then(|()| fs::File::create(&path));
    let changed = file.and_then(|file| file.metadata()?.modified());
    let _not_there = fs::remove_file(&path);
    changed.unwrap_or_else(|_| SystemTime::now())
}

/// The name under which a staged write, such as `sweep-0#1`, will be renamed when it is complete. None if
/// the file is no staged write.
fn staged_of(path: &Path) -> Option<String> {
    let name = path.file_name()?.to_string_lossy();
    let (name, number) = name.rsplit_once('#')?;
    let is_number = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    is_number.then(|| name.to_owned())
}

/// Whether a file was last changed by `limit`. A file that is gone meanwhile counts as older.
fn is_older(path: &Path, limit: Option<SystemTime>) -> io::Result<bool> {
    match fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(true),
        about => {
            let changed = about?.modified()?;
            Ok(limit.is_some_and(|limit| changed <= limit))
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
