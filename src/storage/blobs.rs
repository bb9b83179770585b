//! Where payloads, snapshots and results lie: files below one folder, by job.
//!
//! Written whole or not at all. What a promise rests on is on disk before the call returns; what
//! dies with its caller does not wait for the disk. It must not know what the bytes mean.

use std::fs::{self, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path as FilePath, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use object_store::ObjectStoreExt;
use object_store::local::LocalFileSystem;
use object_store::path::Path;

use crate::fault::Fault;
use crate::job::JobId;

/// Payloads, snapshots and results.
#[derive(Clone, Debug)]
pub struct Blobs {
    folder: Arc<FilePath>,
    synced: Arc<LocalFileSystem>,
    quick: Arc<LocalFileSystem>,
}

/// Whether a write waits for the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sync {
    /// It does: somebody is promised something.
    Yes,
    /// It does not: it survives the process, but perhaps not the machine.
    No,
}

/// Something that lies under a job's name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blob {
    /// One of its sweeps, from 0.
    Frame(u32),
    /// The latest snapshot of its optimization.
    Snapshot,
    /// The flow, or the cloud, that one attempt has found.
    Result(u32),
    /// The field that one attempt has fitted, for those who go on from it. By attempt, so that one
    /// that is late cannot change what others have read.
    Field(u32),
}

/// Why a blob could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("the blob store failed: {0}")]
pub struct BlobError(#[from] object_store::Error);

impl BlobError {
    /// Whether there is no such blob.
    pub fn is_missing(&self) -> bool {
        self.fault() == Fault::Missing
    }

    /// Whose fault it is.
    pub fn fault(&self) -> Fault {
        match &self.0 {
            object_store::Error::NotFound { .. } => Fault::Missing,
            error => Fault::of(error),
        }
    }
}

impl From<io::Error> for BlobError {
    fn from(error: io::Error) -> Self {
        Self(object_store::Error::Generic {
            store: "files",
            source: Box::new(error),
        })
    }
}

/// What can still be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FreeSpace {
    /// Bytes.
    pub bytes: u64,
    /// Files and folders; none where the file system does not count them.
    pub inodes: Option<u64>,
}

/// The file that says which store this is.
const IDENTITY: &str = "identity";

/// A job's folder. Names begin with their time, so siblings are of about one minute.
fn folder(id: JobId) -> String {
    let name = id.to_string();
    format!("jobs/{}/{name}", &name[..8])
}

fn path(id: JobId, blob: Blob) -> Path {
    let folder = folder(id);
    Path::from(match blob {
        Blob::Frame(place) => format!("{folder}/frame-{place}"),
        Blob::Snapshot => format!("{folder}/snapshot"),
        Blob::Result(attempt) => format!("{folder}/result-{attempt}"),
        Blob::Field(attempt) => format!("{folder}/field-{attempt}"),
    })
}

impl Blobs {
    /// Opens or makes the store in `folder`.
    ///
    /// # Errors
    /// Where the folder cannot be used.
    pub fn open(folder: &FilePath) -> Result<Self, BlobError> {
        fs::create_dir_all(folder)?;
        // Also where an earlier version made it for everybody.
        fs::set_permissions(folder, Permissions::from_mode(0o700))?;
        let open = || -> Result<LocalFileSystem, BlobError> {
            Ok(LocalFileSystem::new_with_prefix(folder)?.with_automatic_cleanup(true))
        };
        Ok(Self {
            folder: Arc::from(folder),
            synced: Arc::new(open()?.with_fsync(true)),
            quick: Arc::new(open()?),
        })
    }

    /// What can still be written; none where the system does not say. It may wait for a disk that
    /// hangs: not to be called where requests are answered.
    pub fn free_space(&self) -> Option<FreeSpace> {
        let filesystem = rustix::fs::statvfs(&*self.folder).ok()?;
        Some(FreeSpace {
            bytes: filesystem.f_bavail.saturating_mul(filesystem.f_frsize),
            inodes: (filesystem.f_files > 0).then_some(filesystem.f_favail),
        })
    }

    /// The number that was written here when the store was made; none where there is none.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn identity(&self) -> io::Result<Option<i32>> {
        match fs::read_to_string(self.folder.join(IDENTITY)) {
            Ok(text) => match text.trim().parse() {
                Ok(identity) => Ok(Some(identity)),
                Err(_) => Err(io::ErrorKind::InvalidData.into()),
            },
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Writes the number that says which store this is.
    ///
    /// # Errors
    /// Where it cannot be written.
    pub fn set_identity(&self, identity: i32) -> io::Result<()> {
        let mut file = fs::File::create(self.folder.join(IDENTITY))?;
        writeln!(file, "{identity}")?;
        file.sync_all()
    }

    /// Writes, waits for the disk, reads back and removes a file, and looks whether this is still the
    /// store of that `identity` and has room for `needed` bytes: what a job needs of it.
    ///
    /// # Errors
    /// Where any of it fails.
    pub async fn probe(&self, identity: i32, needed: u64) -> Result<(), BlobError> {
        const BYTES: usize = 64 << 10;
        const ROOM: u64 = 4 << 20;
        let (store, path) = (self.clone(), self.folder.join("jobs/probe"));
        in_background(move || {
            // A volume that is not mounted is an empty folder that can be written.
            if store.identity()? != Some(identity) {
                return Err(io::Error::other(
                    "the payloads are not there: is their volume mounted?",
                ));
            }
            fs::create_dir_all(store.folder.join("jobs"))?;
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
            match store.free_space() {
                Some(free) if free.bytes < least => Err(io::ErrorKind::StorageFull.into()),
                _ => Ok(()),
            }
        })
        .await
    }

    /// Writes a blob whole, over what was there.
    ///
    /// # Errors
    /// Where it cannot be written; then nothing is there under this name that was not before.
    pub async fn put(
        &self,
        id: JobId,
        blob: Blob,
        bytes: Bytes,
        sync: Sync,
    ) -> Result<(), BlobError> {
        let store = match sync {
            Sync::Yes => &self.synced,
            Sync::No => &self.quick,
        };
        store.put(&path(id, blob), bytes.into()).await?;
        Ok(())
    }

    /// Reads a blob whole.
    ///
    /// # Errors
    /// Where there is none ([`BlobError::is_missing`]) or it cannot be read.
    pub async fn get(&self, id: JobId, blob: Blob) -> Result<Bytes, BlobError> {
        Ok(self.quick.get(&path(id, blob)).await?.bytes().await?)
    }

    /// Bytes of a blob.
    ///
    /// # Errors
    /// Where there is none ([`BlobError::is_missing`]) or it cannot be looked at.
    pub async fn size(&self, id: JobId, blob: Blob) -> Result<usize, BlobError> {
        let size = self.quick.head(&path(id, blob)).await?.size;
        Ok(usize::try_from(size).unwrap_or(usize::MAX))
    }

    /// Makes a blob that was written without waiting for the disk safe.
    ///
    /// # Errors
    /// As for reading and writing.
    pub async fn sync(&self, id: JobId, blob: Blob) -> Result<(), BlobError> {
        let bytes = self.get(id, blob).await?;
        self.put(id, blob, bytes, Sync::Yes).await
    }

    /// Removes a blob, if it is there.
    ///
    /// # Errors
    /// Where it cannot be removed.
    pub async fn remove(&self, id: JobId, blob: Blob) -> Result<(), BlobError> {
        match self.quick.delete(&path(id, blob)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes all that lies under a job's name, and what a write that was cut off has left there.
    ///
    /// # Errors
    /// Where something cannot be removed.
    pub async fn remove_job(&self, id: JobId) -> Result<(), BlobError> {
        let folder = self.folder.join(folder(id));
        in_background(move || {
            match fs::remove_dir_all(&folder) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
            // Siblings may be left, and then it stays.
            let _not_empty = folder.parent().map(fs::remove_dir);
            Ok(())
        })
        .await
    }

    /// Whether nothing of any job lies here.
    ///
    /// # Errors
    /// Where the folder cannot be listed.
    pub fn is_empty(&self) -> Result<bool, BlobError> {
        // A probe that was cut off is a file; jobs lie in folders.
        Ok(!entries(&self.folder.join("jobs"))?
            .iter()
            .any(|path| path.is_dir()))
    }

    /// The jobs under whose names nothing lies that is younger than `age`, whole or cut off.
    ///
    /// # Errors
    /// Where the store cannot be listed.
    pub async fn jobs_older_than(&self, age: Duration) -> Result<Vec<JobId>, BlobError> {
        let root = self.folder.join("jobs");
        in_background(move || {
            let limit = SystemTime::now().checked_sub(age);
            let is_old = |path: &FilePath| is_older(path, limit);
            let mut found = Vec::new();
            for minute in entries(&root)? {
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
        })
        .await
    }

    /// Removes what writes that were cut off have left, where it is older than `age`. Says how
    /// many files that were.
    ///
    /// # Errors
    /// Where the store cannot be listed or a file cannot be removed.
    pub async fn remove_cut_off(&self, age: Duration) -> Result<usize, BlobError> {
        let root = self.folder.join("jobs");
        in_background(move || {
            let limit = SystemTime::now().checked_sub(age);
            let mut removed = 0;
            for minute in entries(&root)? {
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
        })
        .await
    }
}

/// Whether a file is one that is being written: `frame-0#1`, to be renamed when it is whole.
fn is_staged(path: &FilePath) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.rsplit_once('#')
        .is_some_and(|(_, number)| number.bytes().all(|byte| byte.is_ascii_digit()))
}

/// Whether a file was last changed before `limit`; so it was where it has gone meanwhile.
fn is_older(path: &FilePath, limit: Option<SystemTime>) -> io::Result<bool> {
    match fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(true),
        about => {
            let changed = about?.modified()?;
            Ok(limit.is_some_and(|limit| changed < limit))
        }
    }
}

/// What lies in a folder; nothing where it is not there, or goes meanwhile.
fn entries(folder: &FilePath) -> io::Result<Vec<PathBuf>> {
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

/// Runs what waits for the disk beside the requests.
async fn in_background<T: Send + 'static>(
    work: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> Result<T, BlobError> {
    let done = tokio::task::spawn_blocking(work).await;
    Ok(done.map_err(io::Error::other)??)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn blobs_come_back_and_go_with_their_job() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        assert!(blobs.free_space().is_some_and(|free| free.bytes > 0));
        assert!(blobs.is_empty().expect("a list"));
        assert!(blobs.probe(7, 0).await.is_err(), "it is no store yet");
        blobs.set_identity(7).expect("written");
        blobs.probe(7, 0).await.expect("it can be written");
        assert!(blobs.probe(8, 0).await.is_err(), "it is another store");
        let full = blobs.probe(7, u64::MAX).await.expect_err("too much");
        assert_eq!(full.fault(), Fault::Full);
        assert!(blobs.is_empty().expect("a list"));
        let (id, other) = (JobId::fresh(), JobId::fresh());
        let all = [
            Blob::Frame(0),
            Blob::Frame(1),
            Blob::Snapshot,
            Blob::Result(3),
            Blob::Field(3),
        ];
        for (sync, blob) in [Sync::Yes, Sync::No].into_iter().cycle().zip(all) {
            for id in [id, other] {
                let bytes = Bytes::from(format!("{blob:?}"));
                blobs.put(id, blob, bytes, sync).await.expect("written");
            }
        }
        blobs.sync(id, Blob::Frame(1)).await.expect("synced");
        let back = blobs.get(id, Blob::Frame(1)).await.expect("there");
        assert_eq!(back, "Frame(1)");
        let old = blobs.jobs_older_than(Duration::ZERO).await.expect("a list");
        assert_eq!(old.len(), 2);
        blobs.remove_job(id).await.expect("removed");
        let gone = blobs.get(id, Blob::Frame(0)).await.expect_err("gone");
        assert!(gone.is_missing());
        blobs.get(other, Blob::Frame(0)).await.expect("still there");
        let aged = blobs.jobs_older_than(Duration::from_secs(3600)).await;
        assert!(aged.expect("a list").is_empty());
    }

    #[tokio::test]
    async fn what_a_write_that_was_cut_off_leaves_is_found_and_goes() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let (kept, orphan) = (JobId::fresh(), JobId::fresh());
        let put = blobs.put(kept, Blob::Frame(0), Bytes::from("whole"), Sync::No);
        put.await.expect("written");
        let lies = |id: JobId, name: &str| folder.path().join(super::folder(id)).join(name);
        let orphans = lies(orphan, "frame-0#1");
        fs::create_dir_all(orphans.parent().expect("a folder")).expect("made");
        for staged in [orphans, lies(kept, "result-1#12")] {
            fs::write(staged, "half").expect("written");
        }
        let old = blobs.jobs_older_than(Duration::ZERO).await.expect("a list");
        assert!(old.len() == 2 && old.contains(&orphan));
        blobs.remove_job(orphan).await.expect("removed");
        assert!(!lies(orphan, "").exists());
        let an_hour = Duration::from_secs(3600);
        let removed = |age| blobs.remove_cut_off(age);
        assert_eq!(removed(an_hour).await.expect("a list"), 0);
        assert_eq!(removed(Duration::ZERO).await.expect("a list"), 1);
        assert!(!lies(kept, "result-1#12").exists());
        blobs.get(kept, Blob::Frame(0)).await.expect("still there");
    }
}
