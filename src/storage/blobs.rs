//! Storage of payloads, snapshots and results: files in one folder, by job.
//!
//! A write is atomic. A durable write is on disk before the call returns; an ephemeral one does not
//! wait for the disk. Independent of the content of the blobs.

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

/// The store of payloads, snapshots, motion fields and results: files below one folder, by job.
/// Clones share it. Its async methods need a tokio runtime.
#[derive(Clone, Debug)]
pub struct Blobs {
    folder: Arc<FilePath>,
    synced: Arc<LocalFileSystem>,
    quick: Arc<LocalFileSystem>,
}

/// Whether a write waits for the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fsync {
    /// It waits: the blob is on disk when the write returns.
    Yes,
    /// It does not wait: the blob survives a crash of the process, but perhaps not of the machine.
    No,
}

/// A blob of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blob {
    /// One of its sweeps, by index from 0.
    Sweep(u32),
    /// The latest snapshot of its optimization.
    Snapshot,
    /// The flow, or the dense cloud, of one attempt, by attempt number.
    Result(u32),
    /// The motion field of one attempt, by attempt number, for the jobs that follow and for the
    /// dense cloud. A late attempt cannot change a field that was already read.
    Field(u32),
}

/// Why an operation of the store failed. [`BlobError::fault`] classifies it.
#[derive(Debug, thiserror::Error)]
#[error("the blob store failed: {0}")]
pub struct BlobError(#[from] object_store::Error);

impl BlobError {
    /// Whether the operation failed because the blob or file does not exist.
    pub fn is_missing(&self) -> bool {
        self.fault() == Fault::Missing
    }

    /// The cause: [`Fault::Missing`] if the blob or file does not exist, [`Fault::Full`] if no more
    /// data can be written, otherwise [`Fault::Machine`].
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

/// Free space of the file system that holds the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FreeSpace {
    /// Free bytes for unprivileged processes.
    pub bytes: u64,
    /// Files and folders that can still be created; `None` if the file system does not count them.
    pub inodes: Option<u64>,
}

/// The file that holds the store's identity.
const IDENTITY: &str = "identity";

/// The folder of a job. Ids begin with their time, so the jobs of one parent folder were created
/// within about one minute.
fn folder(id: JobId) -> String {
    let name = id.to_string();
    format!("jobs/{}/{name}", &name[..8])
}

fn path(id: JobId, blob: Blob) -> Path {
    let folder = folder(id);
    Path::from(match blob {
        Blob::Sweep(index) => format!("{folder}/sweep-{index}"),
        Blob::Snapshot => format!("{folder}/snapshot"),
        Blob::Result(attempt) => format!("{folder}/result-{attempt}"),
        Blob::Field(attempt) => format!("{folder}/field-{attempt}"),
    })
}

impl Blobs {
    /// Opens or creates the store in `folder`, and gives the folder the mode 0700.
    ///
    /// # Errors
    /// If the folder cannot be created, opened or given that mode.
    pub fn open(folder: &FilePath) -> Result<Self, BlobError> {
        fs::create_dir_all(folder)?;
        // An existing folder may have other permissions.
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

    /// Free space of the file system that holds the store; `None` if the system does not report it.
    /// The call blocks while the disk hangs, so it must not run on a thread of the async runtime.
    pub fn free_space(&self) -> Option<FreeSpace> {
        let filesystem = rustix::fs::statvfs(&*self.folder).ok()?;
        Some(FreeSpace {
            bytes: filesystem.f_bavail.saturating_mul(filesystem.f_frsize),
            inodes: (filesystem.f_files > 0).then_some(filesystem.f_favail),
        })
    }

    /// The identity of the store: the number of the queue that it belongs to, as
    /// [`crate::queue::Queue::identity`] returns it. `None` if the file `identity` does not exist,
    /// as in a new store.
    ///
    /// # Errors
    /// If the file cannot be read. [`io::ErrorKind::InvalidData`] if it does not hold an `i32` in
    /// decimal digits.
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

    /// Writes the identity of the store to the file `identity`, replacing an earlier one, and waits
    /// for the disk. [`Blobs::probe`] fails until the store has an identity.
    ///
    /// # Errors
    /// If the file cannot be created, written, renamed or synced.
    pub fn set_identity(&self, identity: i32) -> io::Result<()> {
        // A crash leaves the earlier file or the new one, never an empty one.
        let written = self.folder.join("identity.new");
        let mut file = fs::File::create(&written)?;
        writeln!(file, "{identity}")?;
        file.sync_all()?;
        fs::rename(&written, self.folder.join(IDENTITY))?;
        fs::File::open(&self.folder)?.sync_all()
    }

    /// Tests the store. It checks the `identity`, then writes, syncs, reads back and removes a file
    /// of 64 KiB. Last it checks the free space: twice `needed` bytes, at least 4 MiB. This check
    /// is skipped if the system does not report the free space.
    ///
    /// # Errors
    /// [`BlobError`] in these cases:
    /// - The store has another identity, or none.
    /// - A file operation fails, or other bytes are read back.
    /// - There is too little free space. Its fault is [`Fault::Full`].
    pub async fn probe(&self, identity: i32, needed: u64) -> Result<(), BlobError> {
        const BYTES: usize = 64 << 10;
        const ROOM: u64 = 4 << 20;
        let (store, path) = (self.clone(), self.folder.join("jobs/probe"));
        in_background(move || {
            // A volume that is not mounted appears as an empty, writable folder.
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

    /// Writes a blob atomically, replacing an existing one.
    ///
    /// # Errors
    /// If it cannot be written. The blob is then unchanged or, with [`Fsync::Yes`], possibly
    /// replaced.
    pub async fn put(
        &self,
        id: JobId,
        blob: Blob,
        bytes: Bytes,
        sync: Fsync,
    ) -> Result<(), BlobError> {
        let store = match sync {
            Fsync::Yes => &self.synced,
            Fsync::No => &self.quick,
        };
        store.put(&path(id, blob), bytes.into()).await?;
        Ok(())
    }

    /// Reads a whole blob.
    ///
    /// # Errors
    /// If there is none ([`BlobError::is_missing`]) or it cannot be read.
    pub async fn get(&self, id: JobId, blob: Blob) -> Result<Bytes, BlobError> {
        Ok(self.quick.get(&path(id, blob)).await?.bytes().await?)
    }

    /// The size of a blob, bytes.
    ///
    /// # Errors
    /// If there is none ([`BlobError::is_missing`]) or its size cannot be read.
    pub async fn size(&self, id: JobId, blob: Blob) -> Result<usize, BlobError> {
        let size = self.quick.head(&path(id, blob)).await?.size;
        Ok(usize::try_from(size).unwrap_or(usize::MAX))
    }

    /// Makes a blob durable that was written with [`Fsync::No`]: reads it and writes it again with
    /// [`Fsync::Yes`].
    ///
    /// # Errors
    /// If there is none ([`BlobError::is_missing`]), or it cannot be read or written.
    pub async fn sync(&self, id: JobId, blob: Blob) -> Result<(), BlobError> {
        let bytes = self.get(id, blob).await?;
        self.put(id, blob, bytes, Fsync::Yes).await
    }

    /// Removes a blob, if it exists.
    ///
    /// # Errors
    /// If it cannot be removed.
    pub async fn remove(&self, id: JobId, blob: Blob) -> Result<(), BlobError> {
        match self.quick.delete(&path(id, blob)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes all blobs of a job, including the remains of interrupted writes. No effect for a job
    /// without blobs.
    ///
    /// # Errors
    /// If a file cannot be removed. Others may have been removed by then.
    pub async fn remove_job(&self, id: JobId) -> Result<(), BlobError> {
        let folder = self.folder.join(folder(id));
        in_background(move || {
            match fs::remove_dir_all(&folder) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => {}
            }
            // This fails while the folder holds other jobs, as intended.
            let _not_empty = folder.parent().map(fs::remove_dir);
            Ok(())
        })
        .await
    }

    /// Whether the store holds no blobs of any job.
    ///
    /// # Errors
    /// If the folder cannot be listed.
    pub fn is_empty(&self) -> Result<bool, BlobError> {
        // An interrupted probe leaves a file; jobs are folders.
        Ok(!entries(&self.folder.join("jobs"))?
            .iter()
            .any(|path| path.is_dir()))
    }

    /// The jobs whose folder and files were all last changed more than `age` ago. The remains of
    /// interrupted writes count as files.
    ///
    /// # Errors
    /// If the store cannot be listed.
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

    /// Removes the remains of interrupted writes that were last changed more than `age` ago.
    /// Returns the number of files removed.
    ///
    /// # Errors
    /// If the store cannot be listed or a file cannot be removed. Others may have been removed by
    /// then.
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

/// Whether a file is a staged write, such as `sweep-0#1`, which is renamed when it is complete.
fn is_staged(path: &FilePath) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.rsplit_once('#')
        .is_some_and(|(_, number)| number.bytes().all(|byte| byte.is_ascii_digit()))
}

/// Whether a file was last changed before `limit`. A file that is gone meanwhile counts as older.
fn is_older(path: &FilePath, limit: Option<SystemTime>) -> io::Result<bool> {
    match fs::metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(true),
        about => {
            let changed = about?.modified()?;
            Ok(limit.is_some_and(|limit| changed < limit))
        }
    }
}

/// The entries of a folder; empty if the folder does not exist or is not a folder.
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

/// Runs blocking file operations outside the async runtime's workers.
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
            Blob::Sweep(0),
            Blob::Sweep(1),
            Blob::Snapshot,
            Blob::Result(3),
            Blob::Field(3),
        ];
        for (sync, blob) in [Fsync::Yes, Fsync::No].into_iter().cycle().zip(all) {
            for id in [id, other] {
                let bytes = Bytes::from(format!("{blob:?}"));
                blobs.put(id, blob, bytes, sync).await.expect("written");
            }
        }
        blobs.sync(id, Blob::Sweep(1)).await.expect("synced");
        let back = blobs.get(id, Blob::Sweep(1)).await.expect("there");
        assert_eq!(back, "Sweep(1)");
        let old = blobs.jobs_older_than(Duration::ZERO).await.expect("a list");
        assert_eq!(old.len(), 2);
        blobs.remove_job(id).await.expect("removed");
        let gone = blobs.get(id, Blob::Sweep(0)).await.expect_err("gone");
        assert!(gone.is_missing());
        blobs.get(other, Blob::Sweep(0)).await.expect("still there");
        let aged = blobs.jobs_older_than(Duration::from_secs(3600)).await;
        assert!(aged.expect("a list").is_empty());
    }

    #[tokio::test]
    async fn what_a_write_that_was_cut_off_leaves_is_found_and_goes() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        let (kept, orphan) = (JobId::fresh(), JobId::fresh());
        let put = blobs.put(kept, Blob::Sweep(0), Bytes::from("whole"), Fsync::No);
        put.await.expect("written");
        let lies = |id: JobId, name: &str| folder.path().join(super::folder(id)).join(name);
        let orphans = lies(orphan, "sweep-0#1");
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
        blobs.get(kept, Blob::Sweep(0)).await.expect("still there");
    }
}
