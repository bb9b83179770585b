//! The store of payloads, snapshots and results: a folder, or a bucket of an object store.
//!
//! A write is atomic. A durable write is on disk before the call returns; an ephemeral one does not
//! wait for the disk of a folder. Independent of the content of the blobs.

use std::io;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};

use super::blob::{Blob, BlobError, FreeSpace, Fsync, path};
use super::bucket::BucketError;
use super::{bucket, folder};
use crate::job::JobId;

/// The object that holds the store's identity.
const IDENTITY: &str = "identity";

/// The store of payloads, snapshots, motion fields and results, by job. Clones share it. Its async
/// methods need a tokio runtime.
#[derive(Clone, Debug)]
pub struct Blobs {
    synced: Arc<dyn ObjectStore>,
    quick: Arc<dyn ObjectStore>,
    place: Place,
}

/// Where the blobs are.
#[derive(Clone, Debug)]
enum Place {
    Folder(Arc<FilePath>),
    Bucket(Arc<str>),
}

impl Blobs {
    /// Opens or creates the store in a folder, and gives the folder the mode 0700.
    ///
    /// # Errors
    /// If the folder cannot be created, opened or given that mode.
    pub fn open(root: &FilePath) -> Result<Self, BlobError> {
        folder::prepare(root)?;
        let open = || -> Result<LocalFileSystem, BlobError> {
            Ok(LocalFileSystem::new_with_prefix(root)?.with_automatic_cleanup(true))
        };
        Ok(Self {
            synced: Arc::new(open()?.with_fsync(true)),
            quick: Arc::new(open()?),
            place: Place::Folder(Arc::from(root)),
        })
    }

    /// Opens the store in a bucket: `s3://bucket/prefix`, `gs://bucket/prefix` or
    /// `az://container/prefix`. Keys, region and endpoint come from the variables that the vendors'
    /// own programs read, such as `AWS_ACCESS_KEY_ID`, `AWS_REGION` and `AWS_ENDPOINT_URL`. The
    /// bucket is not asked yet.
    ///
    /// # Errors
    /// If the URL is none of these, or a variable has a value that cannot be used.
    pub fn open_bucket(url: &str) -> Result<Self, BucketError> {
        let store = bucket::open(url)?;
        Ok(Self {
            synced: Arc::clone(&store),
            quick: store,
            place: Place::Bucket(Arc::from(url)),
        })
    }

    /// Where the store is: the path of its folder, or the URL of its bucket.
    pub fn location(&self) -> String {
        match &self.place {
            Place::Folder(root) => root.display().to_string(),
            Place::Bucket(url) => (**url).to_owned(),
        }
    }

    /// Free space of the file system that holds the store; `None` if the system does not report it
    /// and for a bucket. The call blocks while the disk hangs, so it must not run on a thread of the
    /// async runtime.
    pub fn free_space(&self) -> Option<FreeSpace> {
        match &self.place {
            Place::Folder(root) => folder::free_space(root),
            Place::Bucket(_) => None,
        }
    }

    /// The identity of the store: the number of the queue that it belongs to, as
    /// [`crate::queue::Queue::identity`] returns it. `None` if the object `identity` does not exist,
    /// as in a new store.
    ///
    /// # Errors
    /// If the object cannot be read, or does not hold an `i32` in decimal digits.
    pub async fn identity(&self) -> Result<Option<i32>, BlobError> {
        let text = match self.quick.get(&Path::from(IDENTITY)).await {
            Ok(found) => found.bytes().await?,
            Err(object_store::Error::NotFound { .. }) => return Ok(None),
            Err(error) => return Err(error.into()),
        };
        let number = String::from_utf8_lossy(&text).trim().parse();
        let invalid = |_| BlobError::from(io::Error::from(io::ErrorKind::InvalidData));
        number.map(Some).map_err(invalid)
    }

    /// Writes the identity of the store to the object `identity`, replacing an earlier one, and
    /// waits for the disk. [`Blobs::probe`] fails until the store has an identity.
    ///
    /// # Errors
    /// If it cannot be written.
    pub async fn set_identity(&self, identity: i32) -> Result<(), BlobError> {
        let text = format!("{identity}\n");
        match &self.place {
            Place::Folder(root) => {
                in_folder(root, move |root| folder::write(root, IDENTITY, &text)).await
            }
            Place::Bucket(_) => {
                self.synced.put(&Path::from(IDENTITY), text.into()).await?;
                Ok(())
            }
        }
    }

    /// Tests the store. It checks the `identity`, then writes, syncs, reads back and removes 64
    /// KiB. Last it checks the free space of a folder: twice `needed` bytes, at least 4 MiB. This
    /// check is skipped if the system does not report the free space.
    ///
    /// # Errors
    /// [`BlobError`] in these cases:
    /// - The store has another identity, or none.
    /// - An operation fails, or other bytes are read back.
    /// - There is too little free space. Its fault is [`Fault::Full`](crate::fault::Fault::Full).
    pub async fn probe(&self, identity: i32, needed: u64) -> Result<(), BlobError> {
        // A volume that is not mounted appears as an empty, writable folder.
        if self.identity().await? != Some(identity) {
            let gone = "the payloads are not there: is their volume mounted?";
            return Err(io::Error::other(gone).into());
        }
        match &self.place {
            Place::Folder(root) => in_folder(root, move |root| folder::probe(root, needed)).await,
            Place::Bucket(_) => bucket::probe(&*self.synced).await,
        }
    }

    /// Writes a blob atomically, replacing an existing one. Large blobs go to a bucket in parts.
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
        let path = path(id, blob);
        if let Place::Bucket(_) = self.place {
            return bucket::put(&*self.synced, &path, bytes).await;
        }
        let store = match sync {
            Fsync::Yes => &self.synced,
            Fsync::No => &self.quick,
        };
        store.put(&path, bytes.into()).await?;
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
    /// [`Fsync::Yes`]. In a bucket it is durable already.
    ///
    /// # Errors
    /// If there is none ([`BlobError::is_missing`]), or it cannot be read or written.
    pub async fn sync(&self, id: JobId, blob: Blob) -> Result<(), BlobError> {
        if let Place::Bucket(_) = self.place {
            return Ok(());
        }
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
    /// If a blob cannot be removed. Others may have been removed by then.
    pub async fn remove_job(&self, id: JobId) -> Result<(), BlobError> {
        match &self.place {
            Place::Folder(root) => in_folder(root, move |root| folder::remove_job(root, id)).await,
            Place::Bucket(_) => bucket::remove_job(&*self.quick, id).await,
        }
    }

    /// Whether the store holds no blobs of any job.
    ///
    /// # Errors
    /// If the store cannot be listed.
    pub async fn is_empty(&self) -> Result<bool, BlobError> {
        match &self.place {
            Place::Folder(root) => in_folder(root, folder::is_empty).await,
            Place::Bucket(_) => bucket::is_empty(&*self.quick).await,
        }
    }

    /// The jobs whose folder and files were all last changed more than `age` ago. The remains of
    /// interrupted writes count as files. None for a bucket, which may be too large to list: a rule
    /// of its own expires what is old.
    ///
    /// # Errors
    /// If the folder cannot be listed.
    pub async fn jobs_older_than(&self, age: Duration) -> Result<Vec<JobId>, BlobError> {
        match &self.place {
            Place::Folder(root) => {
                in_folder(root, move |root| folder::jobs_older_than(root, age)).await
            }
            Place::Bucket(_) => Ok(Vec::new()),
        }
    }

    /// Removes the remains of interrupted writes that were last changed more than `age` ago.
    /// Returns the number of files removed. None for a bucket, whose own rule ends uploads that were
    /// interrupted.
    ///
    /// # Errors
    /// If the folder cannot be listed or a file cannot be removed. Others may have been removed by
    /// then.
    pub async fn remove_cut_off(&self, age: Duration) -> Result<usize, BlobError> {
        match &self.place {
            Place::Folder(root) => {
                in_folder(root, move |root| folder::remove_cut_off(root, age)).await
            }
            Place::Bucket(_) => Ok(0),
        }
    }
}

/// Runs blocking operations on a folder outside the async runtime's workers.
async fn in_folder<T: Send + 'static>(
    root: &Arc<FilePath>,
    work: impl FnOnce(&FilePath) -> io::Result<T> + Send + 'static,
) -> Result<T, BlobError> {
    let root = Arc::clone(root);
    let done = tokio::task::spawn_blocking(move || work(&root)).await;
    Ok(done.map_err(io::Error::other)??)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::super::blob;
    use super::*;
    use crate::fault::Fault;

    #[tokio::test]
    async fn blobs_come_back_and_go_with_their_job() {
        let folder = tempfile::tempdir().expect("a folder");
        let blobs = Blobs::open(folder.path()).expect("a store");
        assert!(blobs.free_space().is_some_and(|free| free.bytes > 0));
        assert!(blobs.is_empty().await.expect("a list"));
        assert!(blobs.probe(7, 0).await.is_err(), "it is no store yet");
        blobs.set_identity(7).await.expect("written");
        blobs.probe(7, 0).await.expect("it can be written");
        assert!(blobs.probe(8, 0).await.is_err(), "it is another store");
        let full = blobs.probe(7, u64::MAX).await.expect_err("too much");
        assert_eq!(full.fault(), Fault::Full);
        assert!(blobs.is_empty().await.expect("a list"));
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
        let lies = |id: JobId, name: &str| folder.path().join(blob::folder(id)).join(name);
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
